"""The documentation site: the Markdown pages as they are in the repository, and a reference from the docstrings.

The source folder is the repository's root, so that links to ARCHITECTURE.md and CHANGELOG.md lead to the same pages
here and on the forge. The links of docs/index.md become, by heading, the navigation of the site.
"""

import ast
import re
import sys
from dataclasses import is_dataclass
from importlib import import_module
from importlib.metadata import version as version_of
from inspect import getdoc
from pathlib import Path
from typing import Any

import yaml
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.domains.python._object import PyObject
from sphinx.util.docutils import SphinxDirective

import vtbdrake
from vtbdrake.settings import declared_settings

project = "vtbdrake"
author = copyright = "The vtbdrake authors"
version = release = version_of("vtbdrake")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["ARCHITECTURE.md", "CHANGELOG.md", "docs/**"]
exclude_patterns = [
    ".*",
    "venv*",
    "build",
    "dist",
    "out",
    "vtbdrake*",
    "diagrams",
    "benchmarks",
    "notebooks",
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

myst_heading_anchors = 3
default_role = "py:obj"  # single backticks in docstrings
highlight_language = "text"  # equations
add_module_names = False
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
maximum_signature_line_length = 100
napoleon_use_ivar = True

API = Path(__file__).parent / "_api"  # written by each build
# The command line, and the projects that it writes, have pages of their own; messages are made by lcm-gen; the names of
# `live` are those of its parent.
WITHOUT_PAGE = ("vtbdrake.cli", "vtbdrake.project", "vtbdrake.recording.lcm_types", "vtbdrake.monitoring.live")
# Modules beside the packages that users import from.
MODULES = ("vtbdrake.deployment", "vtbdrake.settings", "vtbdrake.scan", "vtbdrake.spline")


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


def write_reference() -> None:
    """Write the pages of the reference where they have changed, and remove those of packages that are gone."""
    root = Path(vtbdrake.__file__).parents[1]
    folders = [path.parent.relative_to(root) for path in sorted((root / "vtbdrake").rglob("*/__init__.py"))]
    names = [name for name in map(".".join, (folder.parts for folder in folders)) if not name.startswith(WITHOUT_PAGE)]
    described: set[Any] = set()
    pages = {"vtbdrake": page_of_names()} | {name: page_of_package(name, described) for name in [*names, *MODULES]}
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
    """Add a table of contents, which only the sidebar shows, for each heading of the first page."""
    if page != root_doc:
        return
    tables = {}
    for section in re.split(r"^## ", source[0], flags=re.MULTILINE)[1:]:
        caption, _, text = section.partition("\n")
        tables[caption] = list(dict.fromkeys(re.findall(r"\]\(([^)#:]+)\.md\)", text)))
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
    app.connect("autodoc-process-docstring", mend_docstring, priority=600)  # after napoleon
    app.connect("autodoc-process-signature", mend_signature)
    app.connect("autodoc-skip-member", is_field_of_named_tuple)
