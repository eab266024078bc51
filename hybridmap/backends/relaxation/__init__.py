"""Relaxation rules: that of the paper, a stable variant of it, and that of RatSLAM."""
