"""Learning a field: regimes, drift, outliers, and the choice of a model."""
