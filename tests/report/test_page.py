"""The page of a session: complete, self-contained, the same each time, and usable when little is known."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from hybridmap.errors import StoreError
from hybridmap.evaluate import evaluate_session
from hybridmap.metrics import Metric
from hybridmap.report import write_report
from hybridmap.report.session_page import tiles
from hybridmap.report.session_scene import load_scene
from hybridmap.store import MapStore, SessionFolder
from tests.store.sessions import ring_map, write_session

VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Tags that are open, sources of pictures, and headings."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.links: list[str] = []
        self.tags: set[str] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.sources += [value or "" for name, value in attrs if name == "src"]
        self.links += [value or "" for name, value in attrs if name == "href"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> SessionFolder:
    folder = write_session(tmp_path_factory.mktemp("page") / "session", ring_map(1.5))
    folder.write_metrics(
        {"graph_hash": "abc123", "primary_backend": "gtsam-lm", "backends": ["gtsam-lm"], "remarks": ["3 frames <lost>"]},
        [
            Metric("nodes", 60.0, "1", "nodes of the map"),
            Metric("ate_rmse/odometry", 0.4321, "m", "absolute trajectory error"),
            Metric("ate_rmse/gtsam-lm", 0.01, "m", "absolute trajectory error", bar=0.2, passed=True),
        ],
    )
    return folder


@pytest.fixture(scope="module")
def page(session: SessionFolder) -> Page:
    assert write_report(session) == session.report
    return Page(session.report.read_text())


def test_needs_nothing_beside_it(session: SessionFolder, page: Page) -> None:
    assert page.open == []
    assert page.sources
    assert all(source.startswith(("data:image/svg+xml;base64,", "data:image/jpeg;base64,")) for source in page.sources)
    assert page.links == []
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert not re.search(r"url\(|@import", session.report.read_text())


def test_shows_every_part(page: Page) -> None:
    for part in ("circle", "Map and trajectories", "its loops", "Error over time", "Loop closures", "Figures", "Configuration"):
        assert part in page.text
    assert "backends:\n  names: [gtsam-lm]" in page.text
    assert "abc123" in page.text
    assert "3 frames <lost>" in page.text
    assert "43.2 cm" in page.text
    assert "0.01 ✓" in page.text
    assert "not accepted" in page.text
    assert "matches 8 < 12" in page.text
    assert sum(source.startswith("data:image/jpeg") for source in page.sources) == 2 * 4


def test_one_loop_is_no_plural(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", ring_map(1.2), keyframes=False)
    folder.write_metrics({}, [Metric("nodes", 2.0, "1", "nodes"), Metric("loops_accepted", 1.0, "1", "loop closures")])
    with MapStore.open(folder.path) as store:
        assert [tile.label for tile in tiles(load_scene(folder, store))] == ["nodes", "loop accepted"]


def test_odometry_with_corrected_gains_is_called_so(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", ring_map(1.2), keyframes=False)
    named = {"titles": {"odometry": "odometry, gains corrected"}}
    folder.write_metrics(
        named, [Metric("ate_rmse/odometry", 0.3, "m", "error"), Metric("ate_rmse/gtsam-lm", 0.1, "m", "error")]
    )
    text = Page(write_report(folder).read_text()).text
    assert text.count("odometry, gains corrected") == 2  # the tile and the head of the table


@pytest.mark.parametrize(
    ("reasons", "said"), [([], "Nothing that was checked"), ([{"words": "node 3: <bent>"}], "node 3: <bent>")]
)
def test_begins_with_the_verdict(tmp_path: Path, reasons: list[dict[str, str]], said: str) -> None:
    folder = write_session(tmp_path / "session", ring_map(1.2), keyframes=False)
    folder.write_metrics({"verdict": "doubtful" if reasons else "trusted", "reasons": reasons}, [])
    text = Page(write_report(folder).read_text()).text
    assert text.index("Doubtful." if reasons else "Trusted.") < text.index(said) < text.index("Map and trajectories")


def test_a_session_of_an_earlier_version_has_no_verdict(page: Page) -> None:
    assert "Trusted" not in page.text


def test_same_session_same_page(session: SessionFolder, page: Page) -> None:
    first = session.report.read_bytes()
    assert page.text
    assert write_report(session).read_bytes() == first


def test_shows_the_largest_correction(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", ring_map(1.2), keyframes=False)
    before = ring_map(1.2).initial[:30]
    with MapStore.open(folder.path) as store:
        assert store.info("largest_correction") is None
    put_info(
        folder,
        {"stamp_ns": 30_000_000_000, "node": 29, "shift_m": 0.5, "before": before.tolist(), "after": (before * 1.1).tolist()},
    )
    text = Page(write_report(folder).read_text()).text
    assert "30 s after the start" in text
    assert "by 50 cm" in text


def put_info(folder: SessionFolder, correction: dict) -> None:
    import json
    import sqlite3

    with sqlite3.connect(folder.map_db) as connection:
        connection.execute("INSERT INTO info VALUES (-1, 'largest_correction', ?)", (json.dumps(correction),))
    connection.close()


@pytest.mark.parametrize("known", [{"loops": False}, {"laps": 0.1}], ids=["no loops", "few nodes"])
def test_little_to_show(tmp_path: Path, known: dict) -> None:
    laps = known.pop("laps", 1.1)
    folder = write_session(tmp_path / "session", ring_map(laps, **known), keyframes=False)
    folder.groundtruth.unlink()
    page = Page(write_report(folder).read_text())
    assert page.open == []
    assert "No ground truth is known" in page.text
    assert "Loop closures, looked at" not in page.text


def test_says_what_the_errors_are_against(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", ring_map(1.1), keyframes=False)
    truth = folder.groundtruth.rename(tmp_path / "truth.tum")
    evaluate_session(folder.path, truth)
    text = " ".join(Page(write_report(folder).read_text()).text.split())
    assert "No ground truth is known" not in text
    assert "The session holds no ground truth of its own; all are in the frame map" in text
    assert f"are against the reference {truth}." in text
    assert folder.read_metrics().head["judged_by"] == {"reference": str(truth)}
    truth.rename(folder.groundtruth)
    evaluate_session(folder.path)
    assert folder.read_metrics().head["judged_by"] == {}
    assert "are against the reference" not in write_report(folder).read_text()


def test_without_any_solution(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", ring_map(1.1), solve=False, keyframes=False)
    assert Page(write_report(folder).read_text()).open == []


def test_refuses_a_folder_without_a_session(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no session"):
        write_report(SessionFolder(tmp_path))
