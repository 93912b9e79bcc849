"""Scene files: found, read and checked, with every mistake reported at once."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rig.errors import SceneError
from rig.scene.consistency import mistakes_between
from rig.scene.matrices import FOLDER
from rig.scene.scene import Scene
from rig.scene.settings import Mistake, at, describe, dotted, mistakes_of
from rig.scene.yaml_reader import read

SCENES = Path(__file__).parent / "data" / "scenes"
SUFFIXES = (".yaml", ".yml")
MOST_BYTES = 64_000_000


def load(scene: str | Path) -> Scene:
    """Load a scene.

    Parameters
    ----------
    scene : str or Path
        The name of a bundled scene (`rig scenes` lists them), or the path of a scene file.

    Returns
    -------
    Scene
        Its settings, in SI; the name is that of the file where the file gives none.

    Raises
    ------
    SceneError
        If there is no such scene, or with one line for each mistake in it.

    Examples
    --------
    >>> load("fig8-three-dampers").structure.masses
    (0.74, 0.71, 0.64)
    """
    path = _find(scene)
    return _validated(_text(path), str(path), path.parent, path.stem)


def loads(text: str, where: str = "scene", folder: str | Path | None = None) -> Scene:
    """Load a scene from the text of a scene file.

    Parameters
    ----------
    text : str
        YAML.
    where : str
        What to call it in messages, in place of a file name.
    folder : str or Path, optional
        Where .npy files are found; None: matrices have to be inline.

    Raises
    ------
    SceneError
        With one line for each mistake.
    """
    return _validated(text, where, None if folder is None else Path(folder), None)


def bundled() -> tuple[str, ...]:
    """List the names of the scenes that come with the package."""
    return tuple(sorted(path.stem for path in SCENES.glob("*.yaml")))


def summary(name: str) -> str:
    """Give the first comment of a bundled scene, which says what it is."""
    first = (SCENES / f"{name}.yaml").read_text(encoding="utf-8").split("\n", 1)[0]
    return first.lstrip("# ").strip()


def _find(scene: str | Path) -> Path:
    path = Path(scene)
    names = bundled()
    if isinstance(scene, str) and scene in names:
        return SCENES / f"{scene}.yaml"
    try:
        there, folder = path.exists(), path.is_dir()
    except (OSError, ValueError):
        there = folder = False
    if folder:
        raise SceneError(f"{path} is a folder; expected a scene file or the name of a bundled scene")
    if there and not path.is_file():
        raise SceneError(f"{path} is no ordinary file; expected a scene file or the name of a bundled scene")
    if there:
        return path
    if path.suffix in SUFFIXES or len(path.parts) > 1:
        raise SceneError(
            f"no scene file {path}; expected a path, or the name of a bundled scene (see: rig scenes)"
        )
    near = get_close_matches(str(scene), names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else "see: rig scenes"
    raise SceneError(f"no scene {str(scene)[:100]!r}, neither a bundled one nor a file; {hint}")


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror or error}") from None
    if len(data) > MOST_BYTES:
        raise SceneError(f"{path} is larger than {MOST_BYTES // 1_000_000} MB; expected a scene file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise SceneError(f"{path} is no text file; expected a scene in YAML")
    return text


def _validated(text: str, where: str, folder: Path | None, name: str | None) -> Scene:
    document = read(text)
    content = document.content
    broken = [mistake for _, mistake in document.mistakes if not mistake.place]
    if broken:
        lines = [f"{where}:{line}: {mistake.message}" for line, mistake in document.mistakes]
        raise SceneError("\n".join(lines))
    if not isinstance(content, dict):
        got = "is empty" if content is None else "holds no keys"
        raise SceneError(f"{where} {got}; expected a scene, at least structure: with masses and springs")
    if name is not None and "name" not in content:
        content["name"] = name
    mistakes: list[Mistake] = []
    scene = None
    try:
        scene = Scene.model_validate(content, context={FOLDER: folder})
    except ValidationError as error:
        mistakes = mistakes_of(error)
        found = {(mistake.place, mistake.message) for mistake in mistakes}
        references = _references(content, folder)
        mistakes += [mistake for mistake in references if (mistake.place, mistake.message) not in found]
    twice = [
        f"{where}:{line}: {dotted(mistake.place)}: {mistake.message}" for line, mistake in document.mistakes
    ]
    if scene is None or twice:
        mistakes.sort(key=lambda mistake: document.line(mistake.place))
        raise SceneError("\n".join(filter(None, [*twice, describe(mistakes, where, document.line)])))
    return scene


def _references(content: dict[str, Any], folder: Path | None) -> list[Mistake]:
    """Check what can be checked between the parts that are right in themselves."""

    def part(key: str) -> Any:
        return _valid(key, content.get(key), folder)

    def parts(key: str) -> list[Any]:
        items = content.get(key)
        return [_valid(f"{key}[]", item, folder) for item in items] if isinstance(items, list) else []

    structure = part("structure")
    masses = at(content, ("structure", "masses")) or at(content, ("structure", "matrices", "mass"))
    return mistakes_between(
        structure.bodies if structure else len(masses) if isinstance(masses, list) else None,
        parts("dampers"),
        part("shaker"),
        part("test"),
        parts("channels") or None,
        part("converter"),
        part("recording"),
        frozenset(key for key, value in content.items() if value is not None),
    )


def _valid(key: str, value: Any, folder: Path | None) -> Any:
    if value is None and key not in ("converter", "recording"):
        return None
    try:
        return _adapter(key).validate_python({} if value is None else value, context={FOLDER: folder})
    except ValidationError:
        return None


@cache
def _adapter(key: str) -> TypeAdapter[Any]:
    from rig.scene.damper import Damper
    from rig.scene.excitation import Test
    from rig.scene.measurement_chain import Channel, Converter
    from rig.scene.recording import RecordingSettings
    from rig.scene.shaker import Shaker
    from rig.scene.structure import Structure

    types: dict[str, Any] = {
        "structure": Structure,
        "dampers[]": Damper,
        "shaker": Shaker,
        "test": Test,
        "channels[]": Channel,
        "converter": Converter,
        "recording": RecordingSettings,
    }
    return TypeAdapter(types[key])
