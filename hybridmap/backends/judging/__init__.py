"""Assessment of solutions: certificates, consistency of loops, down-weighted edges."""
