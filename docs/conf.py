"""The documentation site: the Markdown pages as they are in the repository, and a reference from the docstrings.

The source folder is the repository's root, so that links to ARCHITECTURE.md and CHANGELOG.md lead to the same pages
here and on the forge. The lists of docs/index.md become, by heading, cards and the navigation of the site.
"""

import ast
import os
import re
import subprocess
import sys
from dataclasses import is_dataclass
from importlib import import_module
from importlib.metadata import version as version_of
from inspect import getdoc
from pathlib import Path
from pkgutil import walk_packages
from textwrap import dedent
from typing import Any

import yaml
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.domains.python._object import PyObject
from sphinx.util.docutils import SphinxDirective

import vtbdrake
from vtbdrake.common.settings import declared_settings

project = "vtbdrake"
author = copyright = "The vtbdrake authors"
version = release = version_of("vtbdrake")

extensions = [
    "myst_nb",  # with myst_parser
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
root_doc = "docs/index"
include_patterns = ["ARCHITECTURE.md", "CHANGELOG.md", "docs/**", "notebooks/*.ipynb"]
exclude_patterns = [
    ".*",
    "venv*",
    "build",
    "dist",
    "out",
    "vtbdrake*",
    "diagrams",
    "benchmarks",
    "tests",
    "tools",
]
templates_path = ["_templates"]

html_theme = "furo"
html_title = f"vtbdrake {version}"
html_additional_pages = {"index": "to_start.html"}  # the first page is below docs/
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_copy_source = False

nb_execution_mode = "off"  # notebooks show the outputs that tools/run_notebooks.py has stored in them
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
copybutton_exclude = ".linenos, .gp, .go"
default_role = "py:obj"  # single backticks in docstrings
highlight_language = "text"  # equations
add_module_names = False
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
maximum_signature_line_length = 100
napoleon_use_ivar = True

API = Path(__file__).parent / "_api"  # written by each build
# The command line, and the projects that it writes, have pages of their own; messages are made by lcm-gen; the names
# of `live` and of the folders of `web` are described with their parent.
WITHOUT_PAGE = (
    "vtbdrake.cli",
    "vtbdrake.common",
    "vtbdrake.project",
    "vtbdrake.lcm.lcm_types",
    "vtbdrake.recording.lcm_types",
    "vtbdrake.monitoring.live",
    "vtbdrake.web.",
)
# Modules beside the packages that users import from.
MODULES = (
    "vtbdrake.common.settings",
    "vtbdrake.common.scan",
    "vtbdrake.common.spline",
)

# Classes with a page of their own.
CLASSES = ("vtbdrake.testbed.VirtualTestbedBuilder",)
# The building blocks that are no components.
BLOCKS = ("vtbdrake.testbed.slow_part", "vtbdrake.reasoning.onboard")
BLOCKS_PAGE = "docs/building_blocks"
# The page of the example testbeds, and the folder of their recordings beside it.
GALLERY_PAGE = "docs/gallery"
RECORDINGS = "recordings_in_3d"
# The labels of blocks of which a reader needs only one.
WAYS = ("In Python", "On the command line")
BLOCKS_PLACE = "<!-- building blocks: on the site, the ports of each follow here -->"


class PydrakeSystem(SphinxDirective):
    """Shows the ports of a system, which Drake's documentation declares with the same directive."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return a list: the name of each port, and what its line adds."""
        ports = yaml.safe_load("\n".join(self.content))
        result = nodes.field_list()
        for kind in ("input_ports", "output_ports"):
            names = nodes.bullet_list()
            for line in ports.get(kind) or ():
                name, _, rest = str(line).partition(" ")
                names += nodes.list_item("", nodes.paragraph("", "", nodes.literal(text=name), nodes.Text(f" {rest}")))
            if len(names):
                title = kind.replace("_", " ").capitalize()
                result += nodes.field("", nodes.field_name(text=title), nodes.field_body("", names))
        return [result]


def underlined(title: str, line: str = "=") -> list[str]:
    """Return a heading in reStructuredText."""
    return [title, line * len(title), ""]


def page_of_names() -> list[str]:
    """Return the page of the names of `vtbdrake`, which are described with their packages."""
    lines = [*underlined("vtbdrake"), "The names for the four uses; each is imported when it is first used.", ""]
    lines += [".. list-table::", ""]
    for name in vtbdrake.__all__:
        value = getattr(vtbdrake, name)
        summary = (getdoc(value) or "").partition("\n")[0]
        lines += [f"   * - :py:obj:`vtb.{name} <{value.__module__}.{name}>`", f"     - {summary}"]
    return lines


def page_of_package(name: str, described: set[Any]) -> list[str]:
    """Return the page of a package or module: what it lists and no other page describes, or else its modules."""
    package = import_module(name)
    lines = [*underlined(name), f".. automodule:: {name}"]
    if hasattr(package, "__all__"):
        values = {public: getattr(package, public) for public in package.__all__}
        again = [public for public, value in values.items() if callable(value) and value in described]
        described.update(filter(callable, values.values()))
        return [*lines, "   :imported-members:", *([f"   :exclude-members: {', '.join(again)}"] if again else [])]
    if not hasattr(package, "__path__"):
        return lines
    lines += ["   :no-members:", ""]
    for path in sorted(Path(str(package.__file__)).parent.glob("*.py")):
        if path.stem != "__init__":
            lines += [*underlined(path.stem, "-"), f".. automodule:: {name}.{path.stem}", ""]
    return lines


def blocks_by_kind() -> dict[str, dict[str, type]]:
    """Return by folder and name the public systems whose docstrings declare their ports."""
    components = import_module("vtbdrake.components")
    names = [info.name for info in walk_packages(components.__path__, f"{components.__name__}.")]
    kinds: dict[str, dict[str, type]] = {}
    for name in [*sorted(names), *BLOCKS]:
        folder = name.split(".")[2] if name.count(".") > 2 and name not in BLOCKS else "further"
        for value in vars(import_module(name)).values():
            is_own = isinstance(value, type) and value.__module__ == name and not value.__name__.startswith("_")
            if is_own and ".. pydrake_system::" in (value.__doc__ or ""):
                public = value.__name__.partition("_\N{MATHEMATICAL BOLD SCRIPT CAPITAL T}")[0]  # of a class template
                systems = kinds.setdefault(folder.replace("_", " ").capitalize(), {})
                systems.setdefault(public, value)
    return dict(sorted(kinds.items(), key=lambda kind: (kind[0] == "Further", kind[0] != "Sensors")))


def declared_ports(value: type) -> list[tuple[str, str, str]]:
    """Return (input or output, name, remark) of the ports that the docstring of a system declares."""
    text = re.search(r"\.\. pydrake_system::\n\n((?: +.*\n|\n)+?)(?=\n\S|\Z)", getdoc(value) or "")
    declared = yaml.safe_load(dedent(text[1])) if text else {}
    ports = []
    for direction in ("input", "output"):
        for line in declared.get(f"{direction}_ports") or ():
            # YAML takes a line with a colon for a mapping.
            text = ": ".join(next(iter(line.items()))) if isinstance(line, dict) else str(line)
            name, remark = re.match(r"(<[^>]*>|\S+)\s*(.*)", text).groups()  # type: ignore[union-attr]
            ports.append((direction, name, remark))
    return ports


def add_building_blocks(app: Sphinx, page: str, source: list[str]) -> None:
    """Put a table of the ports of each building block into its page."""
    if page != BLOCKS_PAGE:
        return
    lines = []
    for kind, values in blocks_by_kind().items():
        lines += [f"### {kind}", ""]
        for public, value in values.items():
            summary = (getdoc(value) or "").partition("\n\n")[0].replace("\n", " ").replace("`", "")
            lines += [f"#### {public}", "", f"{{py:obj}}`{value.__module__}.{public}`: {summary}", ""]
            lines += ["| port | | |", "|---|---|---|"]
            lines += [f"| `{name}` | {direction} | {remark} |" for direction, name, remark in declared_ports(value)]
            lines += [""]
    source[0] = source[0].replace(BLOCKS_PLACE, "\n".join(lines))


def cards(text: str) -> str:
    """Return a list of links, one per entry, as a grid of cards; entries that are no link with a text stay a list."""
    entries = re.findall(r"^\* (.*(?:\n  .*)*)", text, re.MULTILINE)
    shown, others = [], []
    for entry in entries:
        link = re.match(r"\[((?:[^\]]|\n)+)\]\(([^)#:]+)\.(?:md|ipynb)\)[:,]?\s*((?:.|\n)*)", entry)
        if link is None:
            others.append(f"* {entry}")
            continue
        title, page, rest = (re.sub(r"\s+", " ", part) for part in link.groups())
        rest = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", rest)
        shown += [f":::{{grid-item-card}} {title}", f":link: {page}", ":link-type: doc", "", rest, ":::", ""]
    grid = ["::::{grid} 1 2 3 3", ":gutter: 2", "", *shown, "::::"] if shown else []
    return "\n".join(["", *grid, "", *others, ""])


def show_gallery(app: Sphinx, page: str, source: list[str]) -> None:
    """Make cards of the table of testbeds; those with a recording lead to it."""
    if page != GALLERY_PAGE:
        return
    rows = re.findall(r"^\| !\[(.*?)\]\((.*?)\) \| \*\*(.*?)\*\*: (.*?) \| (.*?) \| (.*?) \|$", source[0], re.MULTILINE)
    shown = []
    for alt, picture, title, text, module, more in rows:
        name = Path(picture).stem
        recording = f"{RECORDINGS}/{name}.html" if Path(app.srcdir, f"docs/gallery/{name}.npz").exists() else ""
        play = [f"```{{button-link}} {recording}", ":color: primary", "", "play in 3D", "```"]
        target = [f":target: {recording}"]
        shown += [f":::{{grid-item-card}} {title}", f"```{{image}} {picture}", f":alt: {alt}"]
        shown += [*(target if recording else []), "```", f"{text[0].upper()}{text[1:]}", "", more, "", module]
        shown += [*(play if recording else []), ":::", ""]
    table = re.search(r"^\| picture(?:.*\n?)*", source[0], re.MULTILINE)
    assert table is not None and rows
    source[0] = "\n".join([source[0][: table.start()], "::::{grid} 1 2 2 3", ":gutter: 3", "", *shown, "::::", ""])


def show_tabs(app: Sphinx, page: str, source: list[str]) -> None:
    """Make tabs of blocks that follow each other, each below one of the labels in `WAYS`: they do the same thing."""
    way = rf"\*\*({'|'.join(WAYS)})\*\*\n\n((?:```\w*\n(?:.*\n)*?```\n\n?)+)"

    def tabs(match: re.Match[str]) -> str:
        items = [
            f":::{{tab-item}} {label}\n:sync: {label}\n\n{blocks.strip()}\n:::\n"
            for label, blocks in re.findall(way, match[0])
        ]
        return "\n".join(["::::{tab-set}", ":sync-group: way", "", *items, "::::", "", ""])

    source[0] = re.sub(rf"^(?:{way}){{2,}}", tabs, source[0], flags=re.MULTILINE)


def write_recordings(app: Sphinx, error: Exception | None) -> None:
    """Write the pages of the gallery's recordings, each complete in itself."""
    if error is None and app.builder.format == "html":
        folder = Path(app.outdir, "docs", RECORDINGS)
        command = [sys.executable, str(Path(app.srcdir, "tools/recordings.py")), "--pages", str(folder)]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(app.srcdir)})


def write_llms_txt(app: Sphinx, error: Exception | None) -> None:
    """Write llms.txt: the pages of the site with their titles, for programs that read."""
    if error is not None or app.builder.format != "html":
        return
    lines = ["# vtbdrake", "", "> Virtual testbeds on Drake: develop, optimize, reason and control with one model.", ""]
    for title, names in (("Pages", "docs/"), ("Reference", "docs/_api/")):
        lines += [f"## {title}", ""]
        for page in sorted(app.env.found_docs):
            if page.startswith(names) and page.startswith("docs/_api/") == (title == "Reference"):
                lines.append(f"- [{app.env.titles[page].astext()}]({page}.html)")
        lines.append("")
    Path(app.outdir, "llms.txt").write_text("\n".join(lines), "utf-8")


def page_of_class(name: str, described: set[Any]) -> list[str]:
    """Return the page of a class, which no other page describes."""
    module, _, class_name = name.rpartition(".")
    described.add(getattr(import_module(module), class_name))
    return [*underlined(class_name), f".. autoclass:: {name}", "   :members:", ""]


def write_reference() -> None:
    """Write the pages of the reference where they have changed, and remove the pages of packages that are gone."""
    root = Path(vtbdrake.__file__).parents[1]
    folders = [path.parent.relative_to(root) for path in sorted((root / "vtbdrake").rglob("*/__init__.py"))]
    names = [name for name in map(".".join, (folder.parts for folder in folders)) if not name.startswith(WITHOUT_PAGE)]
    described: set[Any] = set()
    pages = {"vtbdrake": page_of_names()} | {name: page_of_class(name, described) for name in CLASSES}
    pages |= {name: page_of_package(name, described) for name in [*names, *MODULES]}
    API.mkdir(exist_ok=True)
    for path in API.glob("*.rst"):
        if path.stem not in pages:
            path.unlink()
    for name, lines in pages.items():
        path, text = API / f"{name}.rst", "\n".join(lines)
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def import_types() -> None:
    """Import in each module what it imports for type checkers only, so that signatures lead to the right classes."""
    for name, module in list(sys.modules.items()):
        if name.startswith("vtbdrake.") and str(module.__file__).endswith(".py"):
            for node in ast.parse(Path(str(module.__file__)).read_text("utf-8")).body:
                if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                    exec(ast.unparse(ast.Module(node.body, [])), vars(module))


def add_navigation(app: Sphinx, page: str, source: list[str]) -> None:
    """Make cards of the lists of the first page, and a table of contents, which only the sidebar shows, per heading."""
    if page != root_doc:
        return
    tables = {}
    begin, *sections = re.split(r"^## ", source[0], flags=re.MULTILINE)
    source[0] = begin
    for section in sections:
        caption, _, text = section.partition("\n")
        source[0] += f"## {caption}\n{cards(text)}\n"
        tables[caption] = list(dict.fromkeys(re.findall(r"\]\(([^)#:]+)\.(?:md|ipynb)\)", text)))
    pages = sorted(path.stem for path in API.glob("*.rst"))
    tables["API reference"] = [f"{name.removeprefix('vtbdrake.')} <_api/{name}>" for name in pages]
    for caption, entries in tables.items():
        source[0] += "\n".join(["\n\n```{toctree}", ":hidden:", f":caption: {caption}", "", *entries, "```"])


def with_short_arrays(text: str) -> str:
    """Write the types of arrays as the code does: NDArray[float64]."""
    array = r"~?numpy\.ndarray\[tuple\[(?:~?typing\.)?Any, \.\.\.\], ~?numpy\.dtype\[(.*?)\]\]"
    return re.sub(array, r"~numpy.typing.NDArray[\1]", text)


def is_field_of_named_tuple(
    app: Sphinx, what: str, name: str, value: Any, would_skip: bool, options: Any
) -> bool | None:
    """Skip the fields of a NamedTuple, which the attributes of its docstring describe."""
    return True if str(getattr(value, "__doc__", "")).startswith("Alias for field number") else None


def path_of(name: str, value: Any) -> str:
    """Return the path of a class as the module of ``value`` imports it: two packages may have classes of one name."""
    function = getattr(value, "fget", value)  # of a property
    kind = getattr(sys.modules.get(getattr(function, "__module__", "")), name, None)
    return f"~{kind.__module__}.{name}" if getattr(kind, "__module__", "").startswith("vtbdrake.") else name


def mend_docstring(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Show |x| and indented equations as they are written, and the documentation of the fields of configurations."""
    for index, line in enumerate(lines):
        line = re.sub(r"^:raises (\w+):", lambda match: f":raises {path_of(match[1], value)}:", with_short_arrays(line))
        line = re.sub(r"^:(ivar|param) .*?:", lambda match: match[0].replace(", ", "/"), line)  # several names
        lines[index] = re.sub(r"(`[^`]+`)|\|", lambda match: match[1] or r"\|", line)
        following = [*lines[index + 1 : index + 3], "", ""]
        if re.search(r"[^:]:$", line) and not following[0] and re.match(r" +[^ *.:-]", following[1]):
            lines[index] += ":"
    if what == "class" and is_dataclass(value):
        for field, setting in declared_settings(value).items():
            if setting.doc:
                text = setting.doc.removesuffix(".") + (f" ({setting.range})" if setting.range else "")
                lines += ["", f":ivar {field}: {text}."]


def mend_signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str | None, result: str | None
) -> tuple[str | None, str | None]:
    """Write defaults that a function makes as an ellipsis, which can be parsed, and the types of arrays shortly."""
    parts = [part and with_short_arrays(re.sub(r"<[^>]*>", "...", part)) for part in (signature, result)]
    return parts[0], parts[1]


def setup(app: Sphinx) -> None:
    """Write the reference, and connect what is above."""
    write_reference()
    import_types()
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"  # a variable is something else here
    app.add_directive("pydrake_system", PydrakeSystem)
    app.connect("env-get-outdated", lambda *_: [root_doc])  # its navigation depends on the reference
    app.connect("source-read", add_navigation)
    app.connect("source-read", add_building_blocks)
    app.connect("source-read", show_gallery)
    app.connect("source-read", show_tabs)
    app.connect("build-finished", write_llms_txt)
    app.connect("build-finished", write_recordings)
    app.connect("autodoc-process-docstring", mend_docstring, priority=600)  # after napoleon
    app.connect("autodoc-process-signature", mend_signature)
    app.connect("autodoc-skip-member", is_field_of_named_tuple)
