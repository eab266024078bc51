"""The relaxation rules: the paper's, its stable relative, and RatSLAM's."""
