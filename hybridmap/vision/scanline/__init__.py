"""Loop closure by the paper's means alone: scanline profiles, compared along a stretch of the way."""
