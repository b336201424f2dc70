"""Files of legacy folders: found, read as they were written, refused where they are bad."""

from __future__ import annotations

import base64
import io
import zlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.dataset import DatasetError
from datagen.legacy_files import LegacyFile, list_legacy, read_episode

# Two steps of a point robot, written by NumPy 1.23.5 as the field's scripts do:
# np.save(file, np.array([[obs, action, reward, next_obs], ...])).
OLD = zlib.decompress(
    base64.b85decode(
        "c-ozi%}(1u6otnL6mX&CCoR7%h5~kIngUHBAXG1qK&nMRBO%cRLLSFxkV29(o>Ynei4D-K`#|sreFPqXCA-"
        "!W+f{$mP48kxbLXD(otdwtz3tsk8u?64&9WbO!dx@VvmG;Mm`61sg<CzWiL$TSn{FlW!+yZsx*wjcrJPa7="
        "8SXW|4Y9}d)3BCy_xrF!q1;HD)QJB!fon@!uM*`K#GPZb&zOEua=`*Xb!nVYC~g4U!#Mf({eN?<#b%(Q9N3"
        "f&AP9nYd=K@*(svC_2n8p6uRZ4_qDKhhR3B+>ErjX+KXdL^s?3g`YcX(8}NjO?oTQD+wPYb;E~-?5rfKZh"
        "$55Nt>fA6c0}SiYi;zCKMKPVBP>CTD#RGYc#N1x5CyzYh?f+TA%g#HZiMFDgk0F+^bMvYrrAIKGVt7rD|Ec"
        "#8KqE_y2Z>DW+~>9Af^gpQDoyF^E~r2{GA=`-)y{=$T6NxRBx0jPw_TZE%3=G)ra;|7bTY1*3CmCPekvOs6"
        "g>P7A^mRy0;S~RwRndmsn-_AH7h$lm"
    )
)


def rows(length: int = 3, width: int = 4) -> NDArray[np.object_]:
    """Some steps that go on from each other."""
    found = np.empty((length, width), dtype=object)
    for step in range(length):
        found[step, :4] = [
            np.array([step, -0.5]), np.array([0.25], dtype=np.float32), -0.1 * step,
            np.array([step + 1, -0.5]),
        ]  # fmt: skip
    return found


def saved(path: Path, array: NDArray[np.object_]) -> Path:
    np.save(path, array)
    return path


def test_a_file_of_an_old_numpy_is_read(tmp_path: Path) -> None:
    (tmp_path / "old.npy").write_bytes(OLD)
    episode = read_episode(tmp_path / "old.npy")
    assert episode.observations.tolist() == [[0, 0], [0.5, 0.25]]
    assert episode.actions.tolist() == [[1, -0.5], [0.25, 0]]
    assert episode.rewards.tolist() == [-2.25, -1.5]
    assert episode.next_observations.tolist() == [[0.5, 0.25], [1, 0.5]]


def test_a_file_is_read_as_numpy_reads_it(tmp_path: Path) -> None:
    array = rows(5, 6)
    array[:, 4], array[:, 5] = "ignored", {"as": "well"}
    for made in (array, np.asfortranarray(array)):
        path = saved(tmp_path / "trj.npy", made)
        episode, again = read_episode(path), np.load(path, allow_pickle=True)
        assert len(episode) == 5
        for name, column in (("observations", 0), ("actions", 1), ("next_observations", 3)):
            assert np.array_equal(getattr(episode, name), np.stack(again[:, column]))
        assert episode.rewards.tolist() == again[:, 2].tolist()


def test_rewards_may_be_arrays_of_one_number(tmp_path: Path) -> None:
    array = rows()
    for step, reward in enumerate((np.array([1.5]), np.array(2.5), np.float32(3.5))):
        array[step, 2] = reward
    assert read_episode(saved(tmp_path / "a.npy", array)).rewards.tolist() == [1.5, 2.5, 3.5]


def bad_array(row: int, column: int, value: object) -> bytes:
    array = rows()
    array[row, column] = value
    return as_bytes(array)


def as_bytes(array: NDArray[np.generic]) -> bytes:
    stored = io.BytesIO()
    np.save(stored, array)
    return stored.getvalue()


GOOD = as_bytes(rows())


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "is not a file of NumPy's"),
        (b"text of any kind", "is not a file of NumPy's"),
        (GOOD[:40], "has a damaged header"),
        (GOOD[:-20], "its pickle"),
        (GOOD.replace(b"(3, 4)", b"(3,!4)"), "has a damaged header"),
        (GOOD.replace(b"(3, 4)", b"(4, 3)"), r"its header says \[4, 3\], its pickle \[3, 4\]"),
        (GOOD.replace(b"'shape'", b"'shopa'"), "has a header that is not NumPy's"),
        (as_bytes(np.zeros((3, 4))), "holds no objects"),
        (as_bytes(rows(3)[:, :3]), "not a row a step with 4 values"),
        (as_bytes(rows(3)[:0]), "not a row a step with 4 values"),
        (as_bytes(rows(3)[0]), "not a row a step with 4 values"),
        (bad_array(1, 2, "text"), "has no numbers as the reward of step 1"),
        (bad_array(2, 0, None), "has no numbers as the observation of step 2"),
        (bad_array(0, 1, np.zeros((2, 2))), "has no numbers as the action of step 0"),
        (bad_array(1, 1, np.zeros(2)), "has 2 numbers as the action of step 1, 1 before"),
        (bad_array(1, 3, np.array([1.0, np.nan])), "infinity in the next observation of step 1"),
        (bad_array(2, 2, float("inf")), "infinity in the reward of step 2"),
    ],
)  # fmt: skip
def test_a_bad_file_is_one_sentence(content: bytes, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "trj_evalsample0_step100.npy"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=fault) as caught:
        read_episode(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_rewards_of_several_numbers_are_refused(tmp_path: Path) -> None:
    array = rows()
    for step in range(3):
        array[step, 2] = np.zeros(2)
    with pytest.raises(DatasetError, match="has rewards of 2 numbers"):
        read_episode(saved(tmp_path / "a.npy", array))


def test_a_missing_file_is_a_dataset_error(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="is missing"):
        read_episode(tmp_path / "none.npy")


def test_a_folder_is_listed_by_numbers(tmp_path: Path) -> None:
    for name in (
        "goal_idx10/trj_evalsample0_step100.npy", "goal_idx2/trj_evalsample10_step200.npy",
        "goal_idx2/trj_evalsample9_step200.npy", "goal_idx2/trj_evalsample3_step1000.npy",
        "goal_idx2/trj_eval0_step200.npy", "goal_idx2/agent_200.pt", "other/trj_eval0_step1.npy",
    ):  # fmt: skip
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    two, ten = list_legacy(tmp_path)
    place = tmp_path / "goal_idx2"
    assert (two.task, ten.task) == (2, 10)
    assert two.stochastic == (
        LegacyFile(place / "trj_evalsample9_step200.npy", 200, 9),
        LegacyFile(place / "trj_evalsample10_step200.npy", 200, 10),
        LegacyFile(place / "trj_evalsample3_step1000.npy", 1000, 3),
    )
    assert two.deterministic == (LegacyFile(place / "trj_eval0_step200.npy", 200, 0),)
    assert ten.deterministic == ()


def test_folders_without_episodes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="has no folder goal_idx0"):
        list_legacy(tmp_path)
    (tmp_path / "goal_idx3").mkdir()
    (tmp_path / "goal_idx3" / "trj_evalsample0_step9999999999.npy").touch()
    with pytest.raises(DatasetError, match=r"goal_idx3: has no file trj_evalsample\*_step\*"):
        list_legacy(tmp_path)
    (tmp_path / "goal_idx3" / "trj_evalsample0_step999999999.npy").touch()
    (tmp_path / "goal_idx03").mkdir()
    with pytest.raises(DatasetError, match="has task 3 twice"):
        list_legacy(tmp_path)
