"""Loading of scenes from files, texts and mappings: search, reading and checks; all problems are reported together."""

import warnings
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rig.core.base.errors import SceneError, SceneWarning
from rig.core.scene.changes import Change, parse_changes, parse_options
from rig.core.scene.implausible_values import implausible_values
from rig.core.scene.matrices import FOLDER
from rig.core.scene.scene import Scene
from rig.core.scene.scene_files import find_scene, read_text
from rig.core.scene.yaml_reader import Document, read_yaml
from rig.core.settings.problems import KeyPath, Problem, describe, dotted, problems_of

# Placeholder for the line numbers of content that was not read from a file.
_NO_LINES: dict[KeyPath, int] = {(): 0}
#: Types that a function accepts as a scene.
SceneLike = Scene | str | Path | Mapping[str, Any]


def load(scene: SceneLike, changes: Mapping[str, Any] | None = None) -> Scene:
    """Load a scene.

    Parameters
    ----------
    scene : str, Path, mapping or Scene
        The name of a bundled scene (`rig scenes` lists them), the path of a scene file, or the content of a scene
        file.
    changes : mapping of str to any, optional
        Changed values by key: ``{"test.force": "5 N", "dampers[2].clearance": 1e-3}``. Items count from 1; a list
        key without a number applies to every item; None removes a key.

    Returns
    -------
    Scene
        The validated scene, in SI. If the file gives no name, the scene has the name of the file.

    Raises
    ------
    SceneError
        If the scene does not exist or has problems; the message has one line for each problem.

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
    return _load(scene, parse_changes(changes or {}))


def load_with_options(scene: str, settings: Iterable[str]) -> Scene:
    """Load a scene with the options ``--set KEY=VALUE``, as messages quote them; raise the errors of `load`."""
    return _load(scene, parse_options(settings))


def scene_of(scene: SceneLike) -> Scene:
    """Load a scene from an argument; a `Scene` is returned unchanged."""
    return load(scene)


def _load(scene: SceneLike, changes: Sequence[Change]) -> Scene:
    if isinstance(scene, Scene):
        return (
            _validate(Document(read_yaml(scene.to_yaml()).content, _NO_LINES), scene.name, None, changes)
            if changes
            else scene
        )
    if isinstance(scene, Mapping):
        return _validate(Document(dict(scene), _NO_LINES), "scene", None, changes)
    if not isinstance(scene, str | Path):
        raise SceneError(f"scene: got {scene!r:.60}; expected a name, a path, a mapping or a rig.Scene")
    path = find_scene(scene)
    document = read_yaml(read_text(path))
    if isinstance(document.content, dict):
        document.content.setdefault("name", path.stem)
    return _validate(document, str(path), path.parent, changes)


def loads(text: str, where: str = "scene", folder: str | Path | None = None) -> Scene:
    """Load a scene from the text of a scene file.

    Parameters
    ----------
    text : str
        YAML.
    where : str
        Name of the text in messages, instead of a file name.
    folder : str or Path, optional
        Folder of the .npy files; None: matrices must be inline.

    Returns
    -------
    Scene
        The scene.

    Raises
    ------
    SceneError
        If the scene has problems; the message has one line for each.
    """
    if not isinstance(text, str):
        raise SceneError(f"{where}: got {text!r:.60}; expected the text of a scene file (rig.load takes files)")
    return _validate(read_yaml(text), where, None if folder is None else Path(folder), [])


def loads_si(text: str, where: str) -> Scene:
    """Load a scene from the text of `Scene.to_si_yaml`, which does not contain the user's units.

    Raises `SceneError` if the scene has problems; the message has one line for each.
    """
    with warnings.catch_warnings():
        # Its numbers have no units, in contrast to those of the user, which were checked when the user's file was read.
        warnings.simplefilter("ignore", SceneWarning)
        scene = loads(text, where)
    scene.discard_notation()
    return scene


def _validate(document: Document, where: str, folder: Path | None, changes: Sequence[Change]) -> Scene:
    unreadable = [problem for _, problem in document.problems if not problem.key_path]
    if unreadable:
        lines = [f"{where}:{line}: {problem.message}" for line, problem in document.problems]
        raise SceneError("\n".join(lines))
    if not isinstance(document.content, dict):
        reason = "is empty" if document.content is None else "has no keys"
        raise SceneError(f"{where} {reason}; expected a scene, at least structure: with masses and springs")
    content = document.content
    for change in changes:
        content = change.apply_to(content)
    scene, problems = _try_validation(content, folder)
    if scene is None or document.problems:
        problems.sort(key=lambda problem: document.line(problem.key_path))
        problems_without_changes = {*(_try_validation(document.content, folder)[1] if changes else problems)}
        duplicates = [
            f"{where}:{line}: {dotted(problem.key_path)}: {problem.message}" for line, problem in document.problems
        ]
        invalid = [_describe(problem, where, document, changes, problems_without_changes) for problem in problems]
        raise SceneError("\n".join([*duplicates, *invalid]))
    for warning in implausible_values(scene, content):
        warnings.warn(_describe(warning, where, document, changes, [warning]), SceneWarning, stacklevel=4)
    return scene


def _try_validation(content: dict[str, Any], folder: Path | None) -> tuple[Scene | None, list[Problem]]:
    """Return the settings, or all problems in them."""
    try:
        return Scene.model_validate(content, context={FOLDER: folder}), []
    except ValidationError as error:
        return None, problems_of(error)


def _describe(
    problem: Problem,
    where: str,
    document: Document,
    changes: Sequence[Change],
    problems_without_changes: Container[Problem],
) -> str:
    """Describe a problem at its line of the file or, if a change caused it, at the change."""
    causes = [change for change in changes if change.covers(problem.key_path)]
    if not causes and problem not in problems_without_changes:
        causes = list(changes)
    if causes:
        return describe([problem], f"{where} with {', '.join(map(str, causes))}")
    return describe([problem], where, None if document.lines == _NO_LINES else document.line)
