"""Tables of implementations: own names, names that were registered, and names of installed packages."""

import pytest

from hybridmap import vision
from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.mapper import Mapper
from hybridmap.plugins import Table
from hybridmap.streams.base import Rig


def table():
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
