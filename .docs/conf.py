"""Sphinx configuration: the pages lie with their packages; the reference is generated from the code (`make docs`)."""

from __future__ import annotations

import shutil
import sys
from importlib import import_module, metadata
from pathlib import Path

import matplotlib
import typer
from numpydoc.xref import DEFAULT_LINKS
from typer.testing import CliRunner

from rig.core.base.figure_style import use_style

ROOT = Path(__file__).parents[1]
#: Sources of the site: copies of the pages, with the generated pages next to them, so that addresses have no dots.
SOURCE = ROOT / "build" / "docs-source"
EXAMPLES = ROOT / "build" / "docs-examples"
PAGES = (
    "README.md", "CHANGELOG.md", "[a-z]*/README.md", "*/guide/*.md", "*/core/recording/LAYOUT.md", "recordings/*.png",
)  # fmt: skip
sys.path.insert(0, str(ROOT))

project = "shotrig"
copyright = "shotrig developers"
release = metadata.version("shotrig")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "numpydoc", "sphinx_gallery.gen_gallery"]
root_doc = "index"
html_theme = "furo"
html_title = f"shotrig {release}"
html_logo = html_favicon = "static/logo.svg"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = [("site.js", {"defer": "defer"})]
myst_enable_extensions = ["dollarmath", "colon_fence"]
# Two hyphens of an option are not a dash.
smartquotes = False
# Names in docstrings are links.
default_role = "py:obj"
myst_heading_anchors = 3
numpydoc_show_class_members = False
# Types that a package exports are links; other words of a type are text, since the documentation of Python is not used.
# A name of two packages has its entry in the first of rig, daq and analysis.
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {word: word for word in DEFAULT_LINKS} | {
    alias: f":obj:`{alias} <{package}.{name}>`"
    for package in ("analysis", "daq", "rig")
    for name in import_module(package).__all__
    if isinstance(getattr(import_module(package), name), type)
    for alias in (name, f"{package}.{name}")
}
autodoc_typehints = "none"
autodoc_member_order = "bysource"
# Each example runs, and its figures and prints are shown.
sphinx_gallery_conf = {
    "examples_dirs": str(EXAMPLES),
    "gallery_dirs": str(SOURCE / "gallery"),
    "filename_pattern": r"\.py$",
    "ignore_pattern": "__init__",
    "abort_on_example_error": True,
    "download_all_examples": False,
    # Labels of axes are legible in two columns.
    "thumbnail_size": (640, 480),
    "write_computation_times": False,
    # Only results have a representation that a reader needs.
    "capture_repr": ("_repr_html_",),
    # The style below applies to all examples.
    "reset_modules": (),
}


def copy_pages() -> None:
    """Copy pages and pictures to the sources of the site."""
    for pattern in PAGES:
        for page in ROOT.glob(pattern):
            copy = SOURCE / page.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(page, copy)
    shutil.copy(ROOT / ".docs" / "index.md", SOURCE)
    # The start page has the name of the product: links to the README name its content.
    readme = SOURCE / "README.md"
    readme.write_text(readme.read_text(encoding="utf-8").replace("# shotrig\n", "# Overview\n", 1), encoding="utf-8")


def write_examples() -> None:
    """Copy the examples next to the recordings that they read."""
    shutil.rmtree(EXAMPLES, ignore_errors=True)
    shutil.copytree(ROOT / "analysis" / "examples", EXAMPLES, ignore=shutil.ignore_patterns("__*"))
    (EXAMPLES / "recordings").mkdir()
    for file in (ROOT / "recordings").glob("demo-*.mcap"):
        shutil.copy(file, EXAMPLES / "recordings")
    title = "Gallery\n=======\n\nWorked examples. The scripts are in ``analysis/examples``.\n"
    (EXAMPLES / "GALLERY_HEADER.rst").write_text(title, encoding="utf-8")


def write_reference() -> None:
    """Write a page for each package's public names, for the commands and for the keys of scene files."""
    from rig.core.scene.reference import reference_page

    reference = SOURCE / "reference"
    reference.mkdir(parents=True, exist_ok=True)
    # A name that two packages export has one entry in the index.
    entries: dict[int, str] = {}
    for package in ("rig", "daq", "analysis"):
        module = import_module(package)
        lines = [f"# {package}: Python names", ""]
        groups: dict[str, list[str]] = {"Functions": [], "Classes": [], "Errors": []}
        for name in sorted(module.__all__, key=str.lower):
            member = getattr(module, name)
            is_class = isinstance(member, type)
            group = "Errors" if is_class and issubclass(member, Exception) else "Classes" if is_class else "Functions"
            groups[group].append(name)
        for group, names in groups.items():
            if not names:
                continue
            lines += [f"## {group}", "", "```{eval-rst}", f".. currentmodule:: {package}", ""]
            for name in names:
                purpose = (getattr(module, name).__doc__ or "").strip().split("\n")[0]
                entry = entries.setdefault(id(getattr(module, name)), f"{package}.{name}")
                lines.append(f"- :obj:`{package}.{name} <{entry}>`: {purpose}")
            lines.append("")
            for name in names:
                member = getattr(module, name)
                lines.append(f".. auto{'function' if group == 'Functions' else 'class'}:: {name}")
                # Common members of all results, settings and errors are not repeated at each of them.
                if group != "Functions":
                    lines += ["   :members:", "   :inherited-members: Result, Settings, BaseModel, Exception"]
                lines += ["   :no-index:"] if entries[id(member)] != f"{package}.{name}" else []
                lines.append("")
            lines += ["```", ""]
        (reference / f"{package}.md").write_text("\n".join(lines), encoding="utf-8")
        (reference / f"{package}-commands.md").write_text(commands(package), encoding="utf-8")
    (reference / "scenes.md").write_text(reference_page().replace("^2", "²").replace("^3", "³"), encoding="utf-8")


def commands(package: str) -> str:
    """Give the help of every command of a package as a page."""
    app = import_module(f"{package}.commands.cli").app
    known = typer.main.get_command(app).commands
    text = f"# {package}: commands\n\n| command | purpose |\n|---|---|\n"
    text += "".join(
        f"| [`{package} {name}`](#{package}-{name}) | {each.get_short_help_str(99)} |\n" for name, each in known.items()
    )
    for name in known:
        shown = CliRunner().invoke(app, [name, "--help"], prog_name=package, terminal_width=98).output
        text += f"\n## {package} {name}\n\n```text\n{shown}```\n"
    return text


use_style()
# Labels are legible in thumbnails.
matplotlib.rcParams.update({"figure.figsize": (4.9, 3.4), "axes.titlesize": 8.5, "savefig.dpi": 180})
copy_pages()
write_reference()
write_examples()
