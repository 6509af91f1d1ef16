"""Model probabilities from evidences, their prior sensitivity, and model averages."""
