"""Scene files: found, read and checked, with every mistake reported at once."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rig.errors import SceneError, SceneWarning
from rig.scene.changes import Change, changes_of, parsed
from rig.scene.doubtful_units import doubts
from rig.scene.matrices import FOLDER
from rig.scene.scene import Scene
from rig.scene.scene_files import find, read_text
from rig.scene.settings import Mistake, Place, describe, dotted, mistakes_of
from rig.scene.yaml_reader import Document, read

# Where a scene's content comes from no file.
_NO_LINES: dict[Place, int] = {(): 0}
#: What a function takes as a scene.
SceneLike = Scene | str | Path | Mapping[str, Any]


def load(scene: SceneLike, changes: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene.

    Parameters
    ----------
    scene : str, Path, mapping or Scene
        The name of a bundled scene (`rig scenes` lists them), the path of a scene file, or what such a file holds.
    changes : mapping of str to any, optional
        What is to differ, by key: ``{"test.force": "5 N", "dampers[2].clearance": 1e-3}``. Items count from 1; a key
        of a list without a number goes to each of its items; None takes a key out.

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
    >>> load("fig8-three-dampers", {"test.force": "5 N"}).test.force
    5.0
    >>> load({"structure": {"masses": {"base": "4.2 kg"}, "springs": ["1 MN/m"]}}).structure.names
    ('base',)
    """
    if changes is not None and not isinstance(changes, Mapping):
        raise SceneError(f'changes: got {changes!r:.60}; expected a mapping such as {{"test.force": "5 N"}}')
    return _loaded(scene, changes_of(changes or {}))


def load_changed(scene: str, settings: Iterable[str]) -> Scene:
    """Load a scene with the changes of a command line, each ``KEY=VALUE``, which messages name as ``--set KEY=VALUE``.

    Raises
    ------
    SceneError
        As `load`.
    """
    return _loaded(scene, parsed(settings))


def scene_of(scene: SceneLike) -> Scene:
    """Take an argument that is a scene, or what `load` takes."""
    return load(scene)


def _loaded(scene: SceneLike, changes: Sequence[Change]) -> Scene:
    if isinstance(scene, Scene):
        return (
            _validated(Document(read(scene.to_yaml()).content, _NO_LINES), scene.name, None, changes)
            if changes
            else scene
        )
    if isinstance(scene, Mapping):
        return _validated(Document(dict(scene), _NO_LINES), "scene", None, changes)
    if not isinstance(scene, str | Path):
        raise SceneError(f"scene: got {scene!r:.60}; expected a name, a path, a mapping or a rig.Scene")
    path = find(scene)
    document = read(read_text(path))
    if isinstance(document.content, dict):
        document.content.setdefault("name", path.stem)
    return _validated(document, str(path), path.parent, changes)


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
    if not isinstance(text, str):
        raise SceneError(
            f"{where}: got {text!r:.60}; expected the text of a scene file (rig.load takes files)"
        )
    return _validated(read(text), where, None if folder is None else Path(folder), [])


def loads_si(text: str, where: str) -> Scene:
    """Load a scene from what `Scene.to_si_yaml` wrote: the units that its user chose are not known.

    Raises
    ------
    SceneError
        With one line for each mistake.
    """
    scene = loads(text, where)
    scene.forget_spelling()
    return scene


def _validated(document: Document, where: str, folder: Path | None, changes: Sequence[Change]) -> Scene:
    broken = [mistake for _, mistake in document.mistakes if not mistake.place]
    if broken:
        lines = [f"{where}:{line}: {mistake.message}" for line, mistake in document.mistakes]
        raise SceneError("\n".join(lines))
    if not isinstance(document.content, dict):
        got = "is empty" if document.content is None else "holds no keys"
        raise SceneError(f"{where} {got}; expected a scene, at least structure: with masses and springs")
    content = document.content
    for change in changes:
        content = change.put_into(content)
    scene, mistakes = _checked(content, folder)
    if scene is None or document.mistakes:
        mistakes.sort(key=lambda mistake: document.line(mistake.place))
        own = _checked(document.content, folder)[1] if changes else mistakes
        twice = [
            f"{where}:{line}: {dotted(mistake.place)}: {mistake.message}"
            for line, mistake in document.mistakes
        ]
        raise SceneError(
            "\n".join([*twice, *(_described(wrong, where, document, changes, own) for wrong in mistakes)])
        )
    for doubt in doubts(scene, content):
        warnings.warn(_described(doubt, where, document, changes, [doubt]), SceneWarning, stacklevel=4)
    return scene


def _checked(content: dict[str, Any], folder: Path | None) -> tuple[Scene | None, list[Mistake]]:
    """Make the settings, or list all mistakes in them."""
    try:
        return Scene.model_validate(content, context={FOLDER: folder}), []
    except ValidationError as error:
        return None, mistakes_of(error)


def _described(
    mistake: Mistake, where: str, document: Document, changes: Sequence[Change], own: Sequence[Mistake]
) -> str:
    """Describe a mistake at its line of the file or, where the file has no such mistake of its own, at the changes."""
    made = [change for change in changes if change.concerns(mistake.place)]
    if not made and mistake not in own:
        made = list(changes)
    if made:
        return describe([mistake], f"{where} with {', '.join(map(str, made))}")
    return describe([mistake], where, None if document.lines == _NO_LINES else document.line)
