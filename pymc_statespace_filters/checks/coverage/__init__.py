"""Whether chains or particles have left parts of the posterior unvisited: importance sampling."""

# So many draws of each population lose hardly any mode.
ALL_MODES = "draw all modes with their probabilities by psf.sample_smc(10_000, model=model)"
