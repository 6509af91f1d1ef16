"""Checks of an evidence that do not depend on the estimator."""
