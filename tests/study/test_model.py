"""A study's configuration: short forms, variants, paths, and refusals that name the key."""

from itertools import product

import pytest

from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.study import StudyConfig, named_studies
from hybridmap.study.cells import lay_out
from hybridmap.study.model import DRIVES, backend_settings
from tests.study.studies import TREE, small

DRIVE = {"sources": ["lab"], "backends": [{"backend": "primary", "way": "mapped"}], "false_loops": {}}


def test_short_forms_are_spelt_out():
    study = small(seeds=3, sources=["lab"], backends=["gtsam-lm", {"backend": "odometry", "name": "none"}])
    assert study.seeds == (0, 1, 2)
    assert (study.sources[0].simulated, study.sources[0].title) == ("lab", "lab")
    assert [(variant.backend, variant.title) for variant in study.backends] == [("gtsam-lm", "gtsam-lm"), ("odometry", "none")]


def test_varied_settings_become_variants_of_their_own():
    entry = {"backend": "relaxation-ratslam", "vary": {"relaxation.theta": [0.2, 0.5], "relaxation.solve_sweeps": [10, 20]}}
    variants = small(backends=[entry]).backends
    assert [variant.title for variant in variants] == [
        "relaxation-ratslam theta=0.2 solve_sweeps=10",
        "relaxation-ratslam theta=0.2 solve_sweeps=20",
        "relaxation-ratslam theta=0.5 solve_sweeps=10",
        "relaxation-ratslam theta=0.5 solve_sweeps=20",
    ]
    settings = backend_settings(variants[1]).relaxation
    assert (settings.theta, settings.solve_sweeps) == (0.2, 20)


def test_the_resolved_study_reads_back_to_an_equal_one(tmp_path, monkeypatch):
    monkeypatch.setenv("GRAPHS", str(tmp_path))
    (tmp_path / "a.yaml").write_text("sources: [{graph: $GRAPHS/a.g2o}]\nbackends: [gtsam-lm]\nseeds: 2\n")
    study = StudyConfig.load(tmp_path / "a.yaml", {"false_loops.rates": [0.1]})
    assert study.sources[0].graph == tmp_path / "a.g2o"
    assert (study.name, study.sources[0].title, study.false_loops.rates) == ("a", "a.g2o", (0.1,))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "b.yaml").write_text(study.to_yaml())
    assert StudyConfig.load(tmp_path / "elsewhere" / "b.yaml") == study


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"seads": 3}, "unknown key 'seads'"),
        ({"backends": [{"backendd": "gtsam-lm"}]}, "unknown key 'backends.0.backendd'"),
        ({"backends": [{"backend": "gtsam-lm", "thata": 1}]}, "unknown key 'backends.0.thata'"),
        ({"backends": [{"backend": "gtsam-lm", "settings": {"relaxation": {"thata": 1}}}]}, "unknown key 'relaxation.thata'"),
        ({"backends": [{"backend": "gtsam-lm", "settings": {"relaxation.theta": 7}}]}, "relaxation.theta: .*found 7"),
        ({"backends": [{"backend": "gtsam-lm", "settings": {"names": ["odometry"]}}]}, "use `backend: NAME`"),
        ({"backends": ["gtsam-ml"]}, "unknown back-end 'gtsam-ml'; there are odometry"),
        ({"backends": ["gtsam-lm", "gtsam-lm"]}, "backends: 'gtsam-lm' is given twice"),
        ({"backends": []}, "backends: "),
        ({"sources": [{"name": "x"}]}, "x: found none, expected one of simulated, recording, session, graph, synthetic"),
        ({"sources": [{"simulated": "lab", "graph": "a.g2o"}]}, "found simulated and graph"),
        ({"sources": [{"world": "lab"}]}, "`world` is now called `simulated`"),
        ({"sources": ["labb"]}, "no world called 'labb'; there are lab"),
        ({"sources": [{"graph": "$NO_SUCH_PLACE/a.g2o"}]}, "NO_SUCH_PLACE is not set"),
        ({"sources": [{"synthetic": {}, "config": "laser"}]}, "for simulated and recording only"),
        ({"sources": [{"simulated": "lab", "relations": "a.txt"}]}, "for recording only"),
        ({"settings": [{"name": "a", "overrides": {"seed": 1}}]}, "is a graph already, and the setting a has overrides"),
        ({"settings": [{"name": "a", "disturb": {"darker": 0.5}}]}, "is a graph already, and the setting a has"),
        ({"backends": [{"backend": "odometry", "way": "mapped"}]}, "is a graph; give the back-ends"),
        (DRIVE | {"false_loops": {"rates": [0.1]}}, "false_loops: they cannot be added to a drive"),
        (DRIVE | {"settings": [{"name": "a", "drift": {"noise": 1.0}}]}, "for a drive as it was mapped use disturb"),
        (
            DRIVE | {"settings": [{"name": "a", "disturb": {"darkr": 0.5}}]},
            "unknown disturbance 'darkr'; there are",
        ),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"darker": 1.5}}]}, "darker: expected 0 to 1, found 1.5"),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"darker": -0.5}}]}, "darker: expected 0 to 1, found -0.5"),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"kidnapped_s": [5, 2, 9]}}]}, "expected .picked up, put down, end."),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"views_late_s": 1e12}}]}, r"expected -10000 to 10000, found 1e\+12"),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"blur_s": 11}}]}, "blur_s: expected 0 to 10, found 11"),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"kidnapped_s": [-1, 2, 9]}}]}, r"expected 0 to 1e\+06, found -1"),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"kidnapped_s": [1, 2, 1e7]}}]}, r"expected 0 to 1e\+06, found 1e\+07"),
        (DRIVE | {"settings": [{"name": "a", "disturb": {"kidnapped_s": 5}}]}, r"expected 3 number\(s\), found 1"),
        (DRIVE | {"backends": [{"backend": "primary", "way": "mapped", "start": "angular"}]}, "takes no settings and no start"),
        ({"backends": [{"backend": "primary"}]}, "unknown back-end 'primary'"),
        ({"bars": [{"figure": "ate", "at_most": 1}]}, "bars: ate: no such figure; there are ate_m"),
        ({"bars": [{"figure": "ate_m"}]}, "bars: ate_m: expected either at_most or at_least"),
        ({"bars": [{"figure": "ate_m", "at_most": "nobody"}]}, "backends has no 'nobody'"),
        ({"bars": [{"figure": "ate_m", "at_most": 1, "rates": 0.5}]}, "false_loops.rates has no '0.5'"),
        ({"false_loops": {"rates": [1.0]}}, "false_loops.rates.0: .*less than 1"),
        ({"seeds": [1, 1]}, "seeds: '1' is given twice"),
        ({"seeds": 0}, "seeds: expected how many there are, 1 to 10000, or a list of them"),
        ({"seeds": -1}, "seeds: expected how many there are, 1 to 10000, or a list of them"),
        ({"seeds": []}, r"seeds: expected at least 1 of them, found \[\]"),
    ],
)
def test_refusals_name_the_key(changes, expected):
    with pytest.raises(ConfigError, match=rf"small.yaml: .*{expected}|{expected}"):
        small(**changes)


def test_a_missing_or_damaged_file_is_refused(tmp_path):
    (tmp_path / "list.yaml").write_text("- 1\n")
    (tmp_path / "torn.yaml").write_text("a: [\n")
    for name, expected in (
        ("none.yaml", "studies that come with"),
        ("list.yaml", "a mapping"),
        ("torn.yaml", "not YAML"),
    ):
        with pytest.raises(ConfigError, match=expected):
            StudyConfig.load(tmp_path / name)


@pytest.mark.parametrize("name", sorted(named_studies()))
def test_every_study_that_comes_along_is_whole(name, monkeypatch, tmp_path):
    monkeypatch.setenv("HYBRIDMAP_DATA", str(tmp_path))
    study = StudyConfig.load(name)
    assert study.description
    assert len(study.backends) > 1 or study.bars
    for source, setting in product(study.sources, study.settings):
        if source.kind in DRIVES and (not setting.sources or source.title in setting.sources):
            named = setting.config or source.config or source.simulated or "laser"
            Config.load(named, {**source.overrides, **setting.overrides})
    if all(source.kind in ("simulated", "synthetic") for source in study.sources):
        assert len({cell.key for cell in lay_out(study).cells}) > 1


def test_the_tree_of_these_tests_is_not_changed_by_reading_it():
    before = repr(TREE)
    small(seeds=2)
    assert repr(TREE) == before
