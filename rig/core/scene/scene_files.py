"""Scene files as text: bundled scenes by their names, other files by their paths."""

from pathlib import Path

from rig.core.base.errors import SceneError, suggestion
from rig.core.base.input_files import read_file

SCENES = Path(__file__).parent / "data" / "scenes"
SUFFIXES = (".yaml", ".yml")


def bundled_scenes() -> tuple[str, ...]:
    """List the names of the scenes that come with the package."""
    return tuple(sorted(path.stem for path in SCENES.glob("*.yaml")))


def summary(name: str) -> str:
    """Return the first comment of a bundled scene, which describes it."""
    first = (SCENES / f"{name}.yaml").read_text(encoding="utf-8").split("\n", 1)[0]
    return first.lstrip("# ").strip()


def find_scene(scene: str | Path) -> Path:
    """Return the path of a scene file, or of a bundled scene by its name; raise `SceneError` if there is none."""
    path = Path(scene)
    names = bundled_scenes()
    if isinstance(scene, str) and scene in names:
        return SCENES / f"{scene}.yaml"
    try:
        exists, is_folder = path.exists(), path.is_dir()
    except (OSError, ValueError):
        exists = is_folder = False
    if is_folder:
        raise SceneError(f"{path} is a folder; expected a scene file or the name of a bundled scene")
    if exists and not path.is_file():
        raise SceneError(f"{path} is a device or a pipe; expected a scene file or the name of a bundled scene")
    if exists:
        return path
    if path.suffix in SUFFIXES or len(path.parts) > 1:
        raise SceneError(
            f"{path}: the file does not exist; expected a scene file, or the name of a bundled scene (see: rig scenes)"
        )
    hint = suggestion(str(scene), names, "`rig scenes` lists the bundled scenes.", n=3, cutoff=0.5)
    raise SceneError(f"{str(scene)[:100]!r} is neither a bundled scene nor a file. {hint}")


def read_text(path: Path) -> str:
    """Read the text of a scene file; raise `SceneError` if it cannot be read or is not text."""
    try:
        text = read_file(path).decode("utf-8-sig")
    except OSError as error:
        raise SceneError(
            f"{path} cannot be read: {error.strerror or error}. Give a scene file that can be read."
        ) from None
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise SceneError(f"{path} is not a text file; expected a scene in YAML")
    return text


def scene_text(scene: str | Path) -> str:
    """Return the text of a scene file, including comments; raise `SceneError` if it is missing or not text."""
    return read_text(find_scene(scene))
