"""Records, likelihoods and filtered states without PyMC."""
