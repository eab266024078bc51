"""Relaxation rules: that of the paper, a stable variant of it, that of RatSLAM, and that with covariances as weights."""
