"""One self-contained page per session: the map, its errors, its corrections, its loop closures and its figures."""

from hybridmap.report.session_page import write_report

__all__ = ["write_report"]
