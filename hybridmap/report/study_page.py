"""One self-contained page per study."""

from __future__ import annotations

from pathlib import Path

from hybridmap.study.folder import PAGE
from hybridmap.study.study import Study


def write_study_page(study: Study) -> Path:
    """Write `report.html` of a study."""
    return study.folder.path / PAGE
