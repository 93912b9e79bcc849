"""The wheel contains every file of the packages, and its commands run outside a checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="the build backend is not installed")
ROOT = Path(__file__).parents[1]
PACKAGES = ("rig", "daq", "analysis")
RECORDING = next(iter(sorted((ROOT / "recordings").glob("*.mcap"))))


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the contents of a wheel that is built from a copy of the checkout, without network."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "shotrig.py"):
        shutil.copy(ROOT / name, source)
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "-w", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(source)], check=True)
    [wheel] = target.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target / "installed")
    return target / "installed"


def test_wheel_contains_every_file(installed: Path) -> None:
    expected = {
        path.relative_to(ROOT)
        for name in PACKAGES
        for path in (ROOT / name).rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc") and not path.name.startswith(".")
    }
    assert {path for path in expected if not (installed / path).is_file()} == set()


@pytest.mark.parametrize("command", ["rig scenes", f"daq info {RECORDING}", "analysis --help", "shotrig --version"])
def test_command_runs_from_wheel(installed: Path, tmp_path: Path, command: str) -> None:
    # The packages of the checkout are not found, because the folder of the wheel is first on the path.
    environment = os.environ | {"PYTHONPATH": str(installed)}
    arguments = [sys.executable, "-m", *command.split(" ", 2)]
    result = subprocess.run(arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout


def test_packages_are_imported_from_wheel(installed: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(installed)}
    code = "import rig, daq, analysis; print(rig.__file__, daq.__file__, analysis.__file__)"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert all(Path(path).is_relative_to(installed) for path in result.stdout.split())
