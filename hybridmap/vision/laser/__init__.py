"""Laser front-end: scans to submaps, submaps to relative poses, hypotheses to committed clusters."""
