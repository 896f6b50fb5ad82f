"""The public interface, compared by griffe with the newest release's.

    python tools/public_api.py            list what a user's program would miss; the exit code is 1 if there is anything
    python tools/public_api.py --write    renew tools/public_api.txt, at a release

tools/public_api.txt is Python with a class in place of every package or module: griffe reads it, a diff shows changes.
"""

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import griffe

ROOT = Path(__file__).resolve().parents[1]
BASELINE = Path(__file__).with_suffix(".txt")
# Programs, messages, and what the parent lists; and the modules beside the packages that users import from.
_NOT_PUBLIC = (
    "vtbdrake.cli",
    "vtbdrake.common",
    "vtbdrake.project",
    "vtbdrake.lcm.lcm_types",
    "vtbdrake.recording.lcm_types",
    "vtbdrake.monitoring.live",
    "vtbdrake.drake_workarounds",
    "vtbdrake.web.",
)
_MODULES = (
    "vtbdrake.common.settings",
    "vtbdrake.common.scan",
    "vtbdrake.common.spline",
)


def public_modules(package: griffe.Object) -> Iterator[tuple[griffe.Object, list[str]]]:
    """Yield each package with the names that it lists; of one that lists none, the modules with their names."""
    listed = getattr(import_module(package.path), "__all__", None)
    for module in sorted(package.modules.values(), key=lambda module: module.name):
        if module.path.startswith(_NOT_PUBLIC) and not any(name.startswith(module.path) for name in _MODULES):
            continue
        if module.is_init_module:
            yield from public_modules(module)
        elif module.path in _MODULES or not (listed or module.path.startswith(_NOT_PUBLIC)):
            here = [member for member in module.members.values() if not member.is_alias and member.is_public]
            yield module, sorted(member.name for member in here if member.is_class or member.is_function)
    if listed:
        yield package, sorted(listed)


def definition(member: griffe.Object | griffe.Alias) -> griffe.Object:
    """Return what a name stands for."""
    return member.final_target if member.is_alias else member


def stub(item: griffe.Object, name: str, indent: str) -> Iterator[str]:
    """Yield the lines that declare a class with its public members, a function, or a value."""
    if item.is_class:
        bases = f"({', '.join(map(str, item.bases))})" if item.bases else ""
        yield f"{indent}class {name}{bases}:"
        members = [member for member in item.members.values() if not member.is_alias]
        public = [member for member in members if member.name == "__init__" or not member.name.startswith("_")]
        for member in public:
            yield from stub(member, member.name, f"{indent}    ")
        if not public:
            yield f"{indent}    pass"
    elif item.is_function:
        start, _, rest = str(item.signature(name=name)).partition("(")
        if item.parent.is_class and "staticmethod" not in item.labels:
            rest = f"{item.parameters[0].name}{'' if rest.startswith(')') else ', '}{rest}"  # griffe leaves it out
        yield f"{indent}def {start}({rest}: ..."
    elif not item.is_module:  # A module that a package lists has a class of its own.
        yield f"{indent}{name}: {item.annotation or 'Any'}"


def listing(package: griffe.Object) -> Iterator[str]:
    """Yield the lines of the public interface; what a package lists again is imported there."""
    yield '"""The public interface of the newest release, see public_api.py."""'
    described: dict[str, str] = {}  # path of the definition -> module
    for module, names in public_modules(package):
        yield f"\nclass {module.path.replace('.', '__')}:"
        for name in names:
            item = definition(module.members[name])
            if described.setdefault(item.path, module.path) == module.path:
                yield from stub(item, name, "    ")
            else:
                yield f"    from {described[item.path]} import {name} as {name}"


def breakages(baseline: Path, package: griffe.Object) -> Iterator[str]:
    """Yield a line for each change of the interface that breaks a user's program."""
    released = griffe.visit(baseline.stem, filepath=baseline, code=baseline.read_text("utf-8"))
    for stand_in in released.classes.values():
        path = stand_in.name.replace("__", ".")
        try:
            module = package[path.partition(".")[2]] if "." in path else package
        except KeyError:
            yield f"{path}: the module was removed"
            continue
        yield from (f"{path}.{name}: it was removed" for name in stand_in.members if name not in module.members)
        pairs = {
            name: member for name, member in stand_in.members.items() if name in module.members and not member.is_alias
        }
        before, after = griffe.Class(path), griffe.Class(path)  # griffe compares no alias
        before.members.update(pairs)
        after.members.update({name: definition(module.members[name]) for name in pairs})
        for breakage in griffe.find_breaking_changes(before, after):
            if breakage.kind is not griffe.BreakageKind.ATTRIBUTE_CHANGED_VALUE:
                yield f"{path}: {breakage.explain(griffe.ExplanationStyle.MARKDOWN)[2:]}"


def main(arguments: list[str]) -> int:
    """Run the program."""
    package = griffe.load("vtbdrake", search_paths=[ROOT], resolve_aliases=True)
    if arguments == ["--write"]:
        BASELINE.write_text("\n".join([*listing(package), ""]), "utf-8")
        return 0
    lines = list(breakages(BASELINE, package))
    if lines:
        print(*lines, sep="\n")
        print("This breaks programs that use the newest release: deprecate first, see CHANGELOG.md.", file=sys.stderr)
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
