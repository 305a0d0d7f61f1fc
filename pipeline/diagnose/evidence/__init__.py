"""Evidence for an effect: score tests, robust fits, cross-validation, consistency, and the selection of one effect."""
