"""An output file is written completely or not at all, and existing files are replaced only if that is allowed."""

import contextvars
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rig.core.base import console
from rig.core.base.errors import RunError, SceneError
from rig.core.base.output_files import (
    ask_before_replacing,
    atomic_write,
    create_folder,
    csv_text,
    file_stem,
    prepare_outputs,
    temporary_folder,
)


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), atomic_write(path, overwrite=True) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert path.read_text(encoding="utf-8") == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("overwrite", [False, True])
def test_no_temporary_file_remains(tmp_path: Path, overwrite: bool) -> None:
    path = tmp_path / "table.csv"
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text("new")
        assert not path.exists() and temporary.suffix == ".csv"
    assert path.read_text(encoding="utf-8") == "new" and list(tmp_path.iterdir()) == [path]


def test_result_gets_another_name_if_file_exists(tmp_path: Path) -> None:
    path, existing = tmp_path / "table.csv", tmp_path / "table-2.csv"
    existing.write_text("older")
    with pytest.raises(SceneError, match=r"table-3\.csv"), atomic_write(path, overwrite=False) as temporary:
        temporary.write_text("new")
        path.write_text("of another process")
    contents = {file.name: file.read_text(encoding="utf-8") for file in tmp_path.iterdir()}
    assert contents == {"table.csv": "of another process", "table-2.csv": "older", "table-3.csv": "new"}


def test_result_gets_another_name_if_folder_exists(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    with pytest.raises(RunError, match=r"table-2\.csv"), atomic_write(path, overwrite=True) as temporary:
        temporary.write_text("new")
        path.mkdir()
    assert path.is_dir() and (tmp_path / "table-2.csv").read_text(encoding="utf-8") == "new"


def test_overwriting_a_link_replaces_its_target(tmp_path: Path) -> None:
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    with atomic_write(link, overwrite=True) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and target.read_text(encoding="utf-8") == "new" and target.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("kind", ["folder", "fifo", "device", "file"])
def test_protected_file_is_not_replaced(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "out.csv"
    match kind:
        case "folder":
            path.mkdir()
        case "fifo":
            os.mkfifo(path)
        case "device":
            path = Path(os.devnull)
        case "file":
            path.touch()
    expected = "exists" if kind == "file" else "is a folder or a device"
    with pytest.raises(SceneError, match=expected), atomic_write(path, overwrite=kind != "file"):
        pass
    assert path.exists()


def test_scene_names_give_readable_files() -> None:
    name = "Fig 9, a damper in body 2 of clearance "
    assert file_stem("design", f"{name}1 mm") == "design-fig-9-a-damper-in-body-2-of-clearance-1-mm"
    assert len(file_stem("design", "word " * 100)) <= len("design-") + 80
    assert file_stem("design", "bracket") == "design-bracket"


def test_missing_folder_of_output_is_created(tmp_path: Path) -> None:
    path = tmp_path / "no" / "such" / "out.csv"
    with atomic_write(path) as temporary:
        temporary.write_text("new")
    assert path.read_text(encoding="utf-8") == "new"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a-folder", "is a folder or a device"),
        ("a-file/out.csv", "a file has this name"),
        ("a-file/below/out.csv", "a file has this name"),
        ("a-file", r"a-file exists\. .*`overwrite`"),
        (f"{'long' * 100}.csv", "too long"),
        pytest.param(
            "/proc/out.csv",
            "accepts no new files",
            marks=pytest.mark.skipif(not Path("/proc").is_dir(), reason="Linux only"),
        ),
    ],
)
def test_unusable_output_is_rejected_in_advance(tmp_path: Path, name: str, expected: str) -> None:
    (tmp_path / "a-folder").mkdir()
    (tmp_path / "a-file").write_text("")
    with pytest.raises(SceneError, match=expected):
        prepare_outputs(tmp_path / name)
    assert {path.name for path in tmp_path.iterdir()} == {"a-folder", "a-file"}


def test_folder_named_like_a_figure_is_used(tmp_path: Path) -> None:
    folder = tmp_path / "two.png"
    with pytest.raises(SceneError, match=r"Give the name of a folder, such as .*two\.$"):
        create_folder(folder)
    folder.mkdir()
    create_folder(folder)


def test_text_of_a_table_is_no_formula() -> None:
    rows = [["=1+1", "@a", "-b", "+c", "-", "-1.5", -2.0, "'=d"], ["body 1", "", "-inf", "1e-3"]]
    assert csv_text(rows) == "'=1+1,'@a,'-b,'+c,-,-1.5,-2.0,''=d\nbody 1,,-inf,1e-3\n"


def test_temporary_file_of_a_killed_process_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    code = (
        "import os, sys; from pathlib import Path; from rig.core.base.output_files import atomic_write\n"
        "with atomic_write(Path(sys.argv[1]), True) as temporary:\n"
        "    temporary.write_text('half'); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.Popen([sys.executable, "-c", code, path])
    # A parent may be slow to collect the exit code.
    os.waitid(os.P_PID, killed.pid, os.WEXITED | os.WNOWAIT)
    (left,) = tmp_path.iterdir()
    with atomic_write(path, True) as temporary, atomic_write(path, True) as other:
        temporary.write_text("new")
        other.write_text("other")
        # The files of running processes stay.
        assert temporary.exists() and other.exists() and not left.exists()
    assert list(tmp_path.iterdir()) == [path]
    killed.wait()


def test_temporary_folder_of_a_killed_process_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "import os; from rig.core.base.output_files import temporary_folder\n"
        "with temporary_folder() as folder:\n"
        "    (folder / 'size.mcap').touch(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, check=False)
    (left,) = tmp_path.iterdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with temporary_folder() as folder, temporary_folder() as other:
        # The folders of running processes stay.
        assert folder.exists() and other.exists() and not left.exists()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("answer", [True, False])
def test_one_question_allows_all_files(tmp_path: Path, answer: bool) -> None:
    paths, questions = [tmp_path / name for name in ("a.csv", "a.png", "new.svg")], []
    for path in paths[:2]:
        path.write_text("old")

    def write() -> None:
        ask_before_replacing(lambda files: questions.append(list(files)) or answer)
        prepare_outputs(*paths)
        for path in paths:
            with atomic_write(path) as temporary:
                temporary.write_text("new")

    if answer:
        contextvars.copy_context().run(write)
    else:
        with pytest.raises(SceneError, match=r"a\.csv, .*a\.png exist\. "):
            contextvars.copy_context().run(write)
    assert questions == [paths[:2]]
    assert paths[0].read_text(encoding="utf-8") == ("new" if answer else "old")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("answer", "expected"), [("y\n", True), ("\n", False), ("", False)])
def test_question_is_asked_on_terminal(monkeypatch: pytest.MonkeyPatch, answer: str, expected: bool) -> None:
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    monkeypatch.setattr("sys.stderr", Terminal())
    assert console.ask_to_replace([Path("a.csv")]) is expected
    assert sys.stderr.getvalue() == "a.csv exists. Replace it? [y/N] "


def test_no_question_without_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert not console.ask_to_replace([Path("a.csv")])
