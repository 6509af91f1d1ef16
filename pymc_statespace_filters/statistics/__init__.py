"""Statistics of weights, mixtures, transforms and chains, which know no model."""
