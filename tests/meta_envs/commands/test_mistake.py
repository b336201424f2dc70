import pytest

from meta_envs.commands.mistake import MistakeError, mistakes
from meta_envs.headless import RenderingUnavailableError


@pytest.mark.parametrize(
    "error",
    [
        ValueError("wrong"),
        RenderingUnavailableError("wrong"),
        ImportError("wrong", name="mujoco.batch"),
    ],
)
def test_what_the_package_refuses_is_a_mistake(error: Exception) -> None:
    with pytest.raises(MistakeError, match=r"^wrong$"), mistakes():
        raise error


@pytest.mark.parametrize("error", [KeyError("ours"), ImportError("ours", name="meta_envs.x")])
def test_a_fault_of_ours_is_none(error: Exception) -> None:
    with pytest.raises(type(error), match="ours"), mistakes():
        raise error


def test_ctrl_c_while_mujoco_is_loaded_is_ctrl_c() -> None:
    """Its compiled modules report an ImportError that comes of the interrupt."""
    inner, outer = ImportError("initialization failed"), ImportError("initialization failed")
    inner.__cause__, outer.__cause__ = KeyboardInterrupt(), inner
    with pytest.raises(KeyboardInterrupt), mistakes():
        raise outer
