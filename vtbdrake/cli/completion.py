"""``vtbdrake completion``: the names of commands, options, scenarios and files in a shell, completed without Drake."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import click
from click.shell_completion import BashComplete, CompletionItem, get_completion_class, split_arg_string

from vtbdrake.common.scenario_names import named_scenarios

_CLASS = re.compile(r"^class (\w+)\(.*Scenario\b.*\):", re.MULTILINE)
# The largest number of modules that are read for names of scenarios.
_MOST_MODULES = 500
_TESTBEDS = "vtbdrake_diagrams"


def complete_scenario(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return short names, ``MODULE:CLASS`` of this folder and of `vtbdrake_diagrams`, and files behind an ``@``.

    Modules are read as text and not imported: a scenario is a class that names a base with "Scenario" in it.

    Args:
        ctx: The command line so far; not used.
        parameter: The argument that is completed; not used.
        incomplete: The text before the cursor.
    """
    name, at, file = incomplete.partition("@")
    if at:
        folder = Path(file).parent
        paths = [path for path in folder.glob("*") if path.is_dir() or path.suffix in (".yaml", ".yml")]
        names = [f"{name}@{path}{'/' * path.is_dir()}" for path in sorted(paths)]
    else:
        short_names = {named.name for named in named_scenarios()}
        names = sorted(short_names) + sorted({*_scenarios(Path.cwd(), ""), *_scenarios_of(_TESTBEDS)})
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def complete_file(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Let the shell complete the name of a file.

    Args:
        ctx: The command line so far; not used.
        parameter: The argument that is completed; not used.
        incomplete: The text before the cursor.
    """
    return [CompletionItem(incomplete, type="file")]


def complete_scenario_or_file(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the scenarios, and the YAML files of a folder.

    Args:
        ctx: The command line so far; not used.
        parameter: The argument that is completed; not used.
        incomplete: The text before the cursor.
    """
    if ":" in incomplete:
        return complete_scenario(ctx, parameter, incomplete)
    folder = Path(incomplete).parent
    names = [str(path) for path in sorted(folder.glob("*")) if path.suffix in (".yaml", ".yml")]
    files = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    return [*complete_scenario(ctx, parameter, incomplete), *files]


def complete_parameter(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the addresses of the parameters of the study in the argument ``file``.

    Args:
        ctx: The command line so far, with the file of the study.
        parameter: The argument that is completed; not used.
        incomplete: The text before the cursor.
    """
    file = Path(str(ctx.params.get("file", "")))
    try:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as study:
            ((record,),) = study.execute("SELECT value FROM meta WHERE key = 'problem'")
            addresses = [described["address"] for described in json.loads(record)["parameters"]]
    except (sqlite3.Error, ValueError, KeyError, TypeError):  # It is no study.
        return []
    return [CompletionItem(address) for address in addresses if address.startswith(incomplete)]


def _scenarios_of(package: str) -> Iterator[str]:
    spec = find_spec(package)
    for place in spec.submodule_search_locations or () if spec is not None else ():
        yield from _scenarios(Path(place), f"{package}.")


def _scenarios(folder: Path, prefix: str) -> Iterator[str]:
    """Yield the scenarios of the modules and packages in a folder, each by the shortest name of its package."""
    for count, path in enumerate(_modules(folder)):
        if count >= _MOST_MODULES:
            return
        parts = list(path.relative_to(folder).with_suffix("").parts)
        try:
            names = _CLASS.findall(path.read_text(encoding="utf-8"))
            package = path.with_name("__init__.py")
            exported = package.read_text(encoding="utf-8") if names and package.exists() else ""
        except (OSError, UnicodeDecodeError):
            continue
        for name in names:
            short = parts[:-1] if re.search(rf"\b{name}\b", exported) and len(parts) > 1 else parts
            yield f"{prefix}{'.'.join(short)}:{name}"


def _modules(folder: Path) -> Iterator[Path]:
    """Yield the modules in a folder and in the packages below it."""
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return
    for entry in entries:
        path = Path(entry.path)
        if path.suffix == ".py" and path.stem.isidentifier():
            yield path
        elif entry.name.isidentifier() and (path / "__init__.py").exists() and not entry.is_symlink():
            yield from _modules(path)


class ColonBash(BashComplete):
    """Completes words with ``:``, ``=`` and ``@``, at which bash begins another word: what follows the last of them."""

    source_template = """\
%(complete_func)s() {
    local IFS=$'\\n' type value
    COMPREPLY=()
    while IFS=',' read -r type value; do
        if [[ $type == dir ]]; then
            compopt -o dirnames
        elif [[ $type == file ]]; then
            compopt -o default
        elif [[ $type == plain ]]; then
            COMPREPLY+=("$value")
        fi
    done < <(env COMP_LINE="${COMP_LINE:0:$COMP_POINT}" %(complete_var)s=bash_complete "$1")
}
complete -o nosort -F %(complete_func)s %(prog_name)s
"""

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before the last one, and the last one, which may be empty."""
        line = os.environ["COMP_LINE"]
        words = split_arg_string(line)[1:]
        return words, words.pop() if words and not line[-1].isspace() else ""

    def format_completion(self, item: CompletionItem) -> str:
        """Return the text that replaces the part of the word that bash takes for the whole."""
        _, incomplete = self.get_completion_args()
        begun = max(incomplete.rfind(sign) for sign in ":=@") + 1
        return f"{item.type},{item.value[begun:]}"


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a script that completes commands and names in a shell.

    Put it into a file that your shell reads at the start. It completes commands, options, scenarios and files.

    \b
    Example:
      vtbdrake completion bash >> ~/.bashrc
      vtbdrake completion zsh >> ~/.zshrc
      vtbdrake completion fish > ~/.config/fish/completions/vtbdrake.fish
    """
    make = get_completion_class(shell)
    assert make is not None
    click.echo(make(ctx.find_root().command, {}, "vtbdrake", "_VTBDRAKE_COMPLETE").source())
