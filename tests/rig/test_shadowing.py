"""Files of the user that hide a module of Python or of a package are reported."""

from __future__ import annotations

from rig.core.base.shadowing import shadowing_files


def test_only_shadowing_files_are_listed(tmp_path):
    for name in ("json.py", "my_test.py", "notes.txt", "2.py"):
        (tmp_path / name).touch()
    (tmp_path / "numpy").mkdir()
    assert [text.partition(" is ")[0] for text in shadowing_files(tmp_path)] == [str(tmp_path / "json.py")]
    (tmp_path / "numpy" / "__init__.py").touch()
    first, second = shadowing_files(tmp_path)
    assert "the module json (" in first and "the module numpy (" in second and second.endswith("Rename the file.")
    assert shadowing_files(tmp_path / "none") == []
