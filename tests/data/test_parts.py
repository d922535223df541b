from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nexwarp.data.sfm import SfmOptions, process
from nexwarp.data.sfm.parts import grouped, separate
from nexwarp.data.sfm.report import Link, Overlaps
from tests.data.test_panoramas import make_walls, pinhole, room, turned


def capture(folder: Path, walls: np.ndarray) -> list[str]:
    """Photos along an arc, from looking at one wall of a room over the next one to the opposite wall."""
    folder.mkdir()
    names = []
    for index, degrees in enumerate(np.linspace(-95, 95, 16)):
        turn = turned(degrees)
        place = np.array([0.0, 0.05 * (-1) ** index, 0.0]) - 0.7 * turn[2]
        names.append(f"{index:02d}.png")
        Image.fromarray(room(walls, place, pinhole(320)[40:280] @ turn)).save(folder / names[-1])
    return names


@pytest.mark.slow
@pytest.mark.parametrize("copies", [False, True])
def test_two_copies_of_one_thing_are_told(copies: bool, tmp_path: Path) -> None:
    walls = make_walls()
    if copies:  # the left wall again on the right
        walls[1] = walls[0, :, ::-1]
    names = capture(tmp_path / "photos", walls)
    report = process(tmp_path / "photos", tmp_path / "scene", options=SfmOptions(camera_model="simple_pinhole"))
    assert len(report.registered) == len(names)
    told = [line for line in report.lines() if "two things look alike" in line]
    if copies:
        link = report.contradictions[0]
        assert not {*link.photos} & {*link.others} and link.matches > 1000 and told
    else:
        assert not report.contradictions and not told and not report.separate


def test_contradicting_pairs_are_grouped_by_their_two_sides() -> None:
    pairs = {("a1", "b1"): 50, ("a2", "b1"): 40, ("b2", "a1"): 30, ("a2", "b2"): 20, ("c", "d"): 10}
    first, second = grouped(pairs)
    assert {tuple(first.photos), tuple(first.others)} == {("a1", "a2"), ("b1", "b2")}
    assert (first.pairs, first.matches) == (4, 140) and (second.pairs, second.matches) == (1, 10) and grouped({}) == []


def test_models_are_reported_with_what_links_them() -> None:
    inliers = {("a", "b"): 90, ("b", "c"): 20, ("a", "d"): 5, ("c", "d"): 70, ("x", "a"): 9}
    overlaps = Overlaps(dict.fromkeys("abcdx", 1000), inliers, 10, sequential=False)
    assert separate(overlaps, [["a", "b"], ["b", "c", "d"], ["a", "b"]]) == [Link(["a", "b"], ["c", "d"], 2, 25)]
    assert separate(overlaps, [["a", "b"]]) == []
