"""Tables of implementations: own names, names that were registered, and names of installed packages."""

import pytest

from hybridmap import vision
from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.mapper import Mapper
from hybridmap.plugins import Table
from hybridmap.streams.base import Rig


def table() -> Table[int]:
    return Table("thing", {"own": 1}, "hybridmap.nothing", ConfigError)


def test_a_registered_name_is_found_after_our_own():
    things = table()
    things.register("theirs", 2)
    assert things.names() == ("own", "theirs")
    assert (things["own"], things["theirs"]) == (1, 2)


@pytest.mark.parametrize("name", ["own", "theirs"])
def test_a_name_is_given_once(name):
    things = table()
    things.register("theirs", 2)
    with pytest.raises(ConfigError, match=name):
        things.register(name, 3)
    assert things["own"] == 1


def test_an_unknown_name_is_told_what_there_is():
    with pytest.raises(ConfigError, match=r"unknown thing 'no'; there are own$"):
        table()["no"]


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """Install a package whose module raises while it is imported; returns the table that it extends."""

    def install(raises: str) -> Table[int]:
        (tmp_path / "brokenthing.py").write_text(f"raise {raises}\n")
        about = tmp_path / "broken_thing-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-thing\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text("[hybridmap.nothing]\ntheirs = brokenthing:make\n")
        monkeypatch.syspath_prepend(tmp_path)
        return table()

    return install


@pytest.mark.parametrize("raises", ["ImportError('no wheel')", "AttributeError('no wheel')", "ValueError('no wheel')"])
def test_a_package_that_cannot_be_imported_is_named(broken, raises):
    with pytest.raises(ConfigError, match=r"thing 'theirs' of the package broken-thing: brokenthing:make .*: no wheel"):
        broken(raises)["theirs"]


def test_ctrl_c_while_a_package_loads_is_no_error_of_the_package(broken):
    with pytest.raises(ImportError) as stopped:
        broken("ImportError('failed') from KeyboardInterrupt()")["theirs"]
    assert isinstance(stopped.value.__cause__, KeyboardInterrupt)


def test_an_unknown_front_end_is_told_what_there_is():
    with pytest.raises(ConfigError, match=r"unknown front-end 'sonar'; there are laser, rgbd, none$"):
        Mapper(Config.load(None, {"vision.sensor": "sonar"}))


def test_a_registered_front_end_is_made_by_its_name(monkeypatch):
    monkeypatch.setattr(vision, "FRONT_ENDS", Table("front-end", {}, "hybridmap.nothing", ConfigError))
    made, front_end = [], object()

    def make(config, rig, seed, clock):
        made.append((config, rig, seed))
        return front_end

    vision.register("sonar", make)
    config = Config.load(None, {"vision.sensor": "sonar"}).vision
    assert vision.create_front_end(config, rig := Rig(), 7) is front_end
    assert made == [(config, rig, 7)]
