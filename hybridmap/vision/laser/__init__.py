"""Laser front-end: scans are merged into submaps, submaps are registered, and loops that agree with each other are accepted."""
