"""Every kind of test and shaker has all its parts, and nothing outside these parts asks for a kind."""

import ast
import inspect
import json
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import pytest

from analysis.core.responses.estimator import MODULES, Estimator
from daq.core.excitation import procedure_of
from daq.core.excitation.procedure import Procedure
from daq.core.recording.recorded_test import FOLLOWED_CURVE, HELD_MOTION, HELD_PHASE, TestKind
from rig.core.base.errors import SceneError
from rig.core.scene import excitation
from rig.core.scene.excitation import KINDS as TESTS
from rig.core.scene.excitation import KindOfTest
from rig.core.scene.scene_files import SCENES
from rig.core.scene.shaker import KINDS as SHAKERS

ROOT = Path(__file__).parents[1]
GUIDES = "\n".join(guide.read_text(encoding="utf-8") for guide in ROOT.glob("*/guide/*.md"))
# Files that may ask for a kind: its owners.
OWNERS = (
    "rig/core/scene/excitation/",
    "rig/core/scene/shaker/",
    *(f"daq/core/excitation/{kind.kind_name()}.py" for kind in TESTS),
    "daq/core/recording/recorded_test.py",
    "analysis/core/responses/estimator.py",
)
CLASSES = {kind.__name__ for kind in (*TESTS, *SHAKERS.values())}
NAMES = {*(kind.kind_name() for kind in TESTS), *SHAKERS}
RECORDED = {kind.value for kind in TestKind} - {TestKind.NONE.value}
# Names of kinds that do not mean anything else; `force` and `table` are also references of responses.
DISTINCT = (NAMES | RECORDED) - {"force", "table"}
KEYS = {key for kind in (*TESTS, *SHAKERS.values()) for key in kind.model_fields} - {"kind"}
# Fields of markers that only one kind of recording or of control has.
OWN_FIELDS = {
    *(kind.field for kind in TestKind if kind.field not in ("", "from", "frequency")),
    *(tones.field for tones in (FOLLOWED_CURVE, HELD_MOTION, HELD_PHASE)),
}


def has_kind(settings: type[KindOfTest]) -> bool:
    """Return whether settings have a value of `kind`; a base class of several kinds has none."""
    return "kind" in settings.model_fields and isinstance(settings.model_fields["kind"].default, str)


def test_settings_of_each_module_are_in_union() -> None:
    for module in iter_modules(excitation.__path__, f"{excitation.__name__}."):
        for name, kind in inspect.getmembers(import_module(module.name), inspect.isclass):
            if kind.__module__ == module.name and issubclass(kind, KindOfTest) and has_kind(kind):
                assert kind in TESTS, f"{excitation.__name__}: add {name} to the union Test"


@pytest.mark.parametrize("kind", TESTS, ids=lambda kind: kind.kind_name())
def test_kind_of_test_has_procedure(kind: type[KindOfTest]) -> None:
    module = f"daq.core.excitation.{kind.kind_name()}"
    assert find_spec(module) is not None, f"{module}: define PROCEDURE"
    procedure = procedure_of(kind)
    is_complete = "excite" in vars(type(procedure)) or kind.wave is not KindOfTest.wave
    assert is_complete, f"{module}: define excite, or wave in the settings"


def test_unknown_detection_is_named() -> None:
    with pytest.raises(SceneError, match=r"Misspelled\.detection is 'hit'; expected one of hits, dwells"):
        type("Misspelled", (Procedure,), {"detection": "hit"})


@pytest.mark.parametrize("kind", TESTS, ids=lambda kind: kind.kind_name())
def test_level_of_force_has_controller(kind: type[KindOfTest]) -> None:
    procedure = type(procedure_of(kind))
    excitation = inspect.getsource(sys.modules[procedure.excite.__module__])
    controllers = {"controlled", "measured_force"}
    is_controlled = controllers & names(ast.parse(excitation)) and procedure.excite is not Procedure.excite
    name = f"daq.core.excitation.{kind.kind_name()}"
    assert "force" not in kind.level_keys or is_controlled, (
        f"{name}: a force in N would be output as a drive in V: control it, or set level_keys = ('drive',)"
    )


@pytest.mark.parametrize("kind", TESTS, ids=lambda kind: kind.kind_name())
def test_long_kind_of_test_has_part(kind: type[KindOfTest]) -> None:
    procedure = procedure_of(kind)
    has_part = procedure.rehearsal == "peaks" or type(procedure).part is not Procedure.part
    name = f"daq.core.excitation.{kind.kind_name()}"
    assert has_part or "duration" in kind.model_fields, f"{name}: define part; the test has no key duration"


@pytest.mark.parametrize("kind", TESTS, ids=lambda kind: kind.kind_name())
def test_kind_of_test_has_kind_of_recording(kind: type[KindOfTest]) -> None:
    assert kind.recorded_as in set(TestKind), f"TestKind: add {kind.recorded_as}"


@pytest.mark.parametrize("kind", TestKind)
def test_kind_of_recording_has_estimator(kind: TestKind) -> None:
    assert kind.value in MODULES, f"analysis.core.responses.estimator.MODULES: add {kind.value}"
    assert isinstance(import_module(f"analysis.core.responses.{MODULES[kind.value]}").ESTIMATOR, Estimator)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_kind_is_in_guide(name: str) -> None:
    assert f"kind: {name}" in GUIDES, f"a guide: explain kind: {name}"


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_kind_is_in_schema(name: str) -> None:
    packaged = json.loads((SCENES.parent / "scene.schema.json").read_text(encoding="utf-8"))["$defs"]
    assert name in packaged, "run: rig schema > rig/core/scene/data/scene.schema.json"
    assert packaged[name]["description"]


def questions(file: Path) -> Iterator[str]:
    """Yield the places at which a module asks for a kind."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        asked: set[str] = set()
        match node:
            case ast.Call(func=ast.Name("isinstance" | "issubclass"), args=[_, kinds]):
                asked = names(kinds) & CLASSES
            case ast.Call(func=ast.Name("getattr" | "hasattr"), args=[_, ast.Constant(key), *_]):
                asked = {key} & KEYS
            case ast.MatchClass(cls=kind):
                asked = names(kind) & CLASSES
            case ast.MatchValue(value=value):
                asked = texts(value) & DISTINCT | members(value)
            case ast.Dict(keys=keys):
                asked = at_least_two({text for key in keys if key for text in texts(key) | names(key)})
            case ast.Tuple(elts=values) | ast.List(elts=values) | ast.Set(elts=values):
                asked = at_least_two({value.value for value in values if isinstance(value, ast.Constant)})
            case ast.FunctionDef(decorator_list=decorators) if "register" in set().union(*map(names, decorators)):
                asked = names(node.args) & CLASSES
            case ast.Compare(left=left, comparators=others):
                sides = [left, *others]
                asked_for = set[str]().union(*map(names, sides))
                values = set[Any]().union(*map(texts, sides))
                of_kind = {"kind", "test_kind", "recorded_as", "kind_name", "__name__"}
                if asked_for & of_kind:
                    is_attribute = any(attributes(side) & of_kind for side in sides)
                    asked = values & (NAMES | RECORDED if is_attribute else DISTINCT)
                if isinstance(left, ast.Constant) and asked_for & {"fields", "model_fields"}:
                    asked |= texts(left) & (OWN_FIELDS if "fields" in asked_for else KEYS)
                asked |= asked_for & CLASSES | {text for side in sides for text in members(side)}
        if asked:
            yield f"{file.relative_to(ROOT)}:{node.lineno}: {', '.join(sorted(asked))}"


def at_least_two(values: set[Any]) -> set[str]:
    """Return the kinds among some values, of which a table or a list has several."""
    kinds = values & (DISTINCT | CLASSES)
    return kinds if len(kinds) > 1 else set()


def names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} | attributes(node)


def attributes(node: ast.AST) -> set[str]:
    return {each.attr for each in ast.walk(node) if isinstance(each, ast.Attribute)}


def texts(node: ast.AST) -> set[Any]:
    return {each.value for each in ast.walk(node) if isinstance(each, ast.Constant)}


def members(node: ast.AST) -> set[str]:
    """Return the members of `TestKind` except NONE, which is no kind of test."""
    return {
        f"TestKind.{each.attr}"
        for each in ast.walk(node)
        if isinstance(each, ast.Attribute) and isinstance(each.value, ast.Name) and each.value.id == "TestKind"
    } - {"TestKind.NONE"}


def test_only_owners_ask_for_a_kind() -> None:
    files = [file for package in ("rig", "daq", "analysis") for file in sorted((ROOT / package).rglob("*.py"))]
    others = [file for file in files if not file.relative_to(ROOT).as_posix().startswith(OWNERS)]
    found = [place for file in others for place in questions(file)]
    assert not found, "state the fact in the class of the kind:\n" + "\n".join(found)


@pytest.mark.parametrize(
    "code",
    [
        "isinstance(test, Sine)",
        "isinstance(test, int | SteppedSine)",
        "isinstance(shaker, (int, shakers.ForceShaker))",
        "scene.test.kind == 'impulse'",
        "shaker.kind not in ('force', 'table')",
        "rec.test.kind is TestKind.HITS",
        "match test:\n    case Sine(): pass",
        "match test.kind:\n    case 'sine': pass",
        "getattr(settings, 'frequencies', None)",
        "hasattr(scene.test, 'frequencies')",
        "'frequencies' in test.model_fields",
        "type(test) is Sine",
        "test.kind_name() == 'sine'",
        "test.recorded_as == 'tones'",
        "COMMANDS = {'tones': 'frf', 'hits': 'decay'}",
        "COMMANDS = {Sine: 'frf', Impulse: 'decay'}",
        "kind in ('random', 'multisine')",
        "'distance' in marker.fields",
        "@show.register\ndef show(test: Sine) -> None: ...",
    ],
)
def test_question_for_a_kind_is_found(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "module.py").write_text(code, encoding="utf-8")
    assert list(questions(tmp_path / "module.py"))
