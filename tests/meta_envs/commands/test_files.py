import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meta_envs.commands.files import check_out, encode_gif, encode_png, write_file
from meta_envs.commands.mistake import MistakeError


def picture(shade: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    found = np.full((30, 40, 3), shade, np.uint8)
    found[5:15, 5:15] = [200, 30, shade]
    return found


def test_a_png_is_the_picture() -> None:
    decoded = np.array(Image.open(io.BytesIO(encode_png(picture(90)))))
    np.testing.assert_array_equal(decoded, picture(90))


def test_a_gif_is_the_pictures_in_order_again_and_again() -> None:
    image = Image.open(io.BytesIO(encode_gif([picture(shade) for shade in (0, 100, 200)], 70)))
    assert image.n_frames == 3  # type: ignore[attr-defined]  # only animations have it
    assert image.info["loop"] == 0
    times = []
    for number, shade in enumerate((0, 100, 200)):
        image.seek(number)
        times.append(image.info["duration"])
        np.testing.assert_allclose(np.array(image.convert("RGB")), picture(shade), atol=2)
    assert times == [70, 70, 1000]


def test_a_file_is_whole_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.png"
    write_file(file, b"old")
    write_file(file, b"new")
    assert file.read_bytes() == b"new"

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(MistakeError, match="cannot be written: No space left on device"):
        write_file(file, b"newer")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert file.read_bytes() == b"new"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.jpg", "the name must end in .gif or .png, which says what to write"),
        ("a", "the name must end in .gif or .png, which says what to write"),
        ("absent/a.png", "there is no folder absent; make it first"),
        ("folder.png", "this is a folder; name a file in it"),
    ],
)
def test_where_no_picture_can_be_written(
    name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(MistakeError) as caught:
        check_out(Path(name), (".gif", ".png"))
    assert str(caught.value) == f"--out {name}: {message}"
    for right in ("a.png", "b.PNG", "c.gif"):
        check_out(Path(right), (".gif", ".png"))
