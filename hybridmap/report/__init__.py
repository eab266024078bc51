"""Self-contained pages: one per session (map, errors, corrections, loop closures), study and comparison of back-ends."""

from hybridmap.report.session_page import write_report

__all__ = ["write_report"]
