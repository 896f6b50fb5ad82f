"""Small FMUs with known solutions, written in C for the tests: a table of variables and the body of a step each."""

from __future__ import annotations

import subprocess
import zipfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import fmpy

from vtbdrake.components.casadi_system.compiler import compiler_command

HEADERS = Path(fmpy.__file__).parent / "c-code"


class Var(NamedTuple):
    """A variable: C code knows its first entry as v[NAME]."""

    name: str
    causality: str
    start: str = ""
    type: str = "Float64"
    attributes: str = ""
    shape: tuple[int, ...] = ()


class Model(NamedTuple):
    """An FMU: `step` changes v, which holds all variables and `hidden` further numbers, from t to t + h.

    It may set `error` to a message, or `end`. It can take the step length `step_size`.
    """

    variables: list[Var]
    step: str
    hidden: int = 0
    has_state: bool = True
    version: int = 3
    platform: str = ""
    step_size: str = "0.01"
    interface: str = "CoSimulation"


U = Var("u", "input", "0")
TUNABLE = 'variability="tunable" min="0" max="9"'


def state(name: str, start: str) -> Var:
    """An output whose start value can be set."""
    return Var(name, "output", start, attributes='initial="exact"')


MODELS = {
    "Integrator": Model(
        [U, Var("k", "parameter", "2.0", attributes=TUNABLE), state("x", "0")],
        "v[X] += v[K] * v[U] * h;",
    ),
    # Free fall with restitution e, exact: the time of each impact is computed.
    "BouncingBall": Model(
        [
            state("h", "1.0"),
            state("v", "0"),
            Var("e", "parameter", "0.7", attributes='variability="fixed"'),
            Var("bounces", "output", type="Int32"),
        ],
        """const double g = 9.81;
        for (double left = h; left > 0;) {
            double impact = (v[V] + sqrt(v[V] * v[V] + 2 * g * v[H])) / g, dt = fmin(impact, left);
            v[H] += v[V] * dt - 0.5 * g * dt * dt, v[V] -= g * dt, left -= dt;
            if (dt == impact) v[H] = 0, v[V] *= -v[E], v[BOUNCES] += 1;
        }""",
    ),
    "VanDerPol": Model(
        [state("x0", "2.0"), state("x1", "0"), Var("mu", "parameter", "1.0")],
        """double a = v[X0], b = v[X1], m = v[MU], d = h / 10;
        for (int i = 0; i < 10; i++) {
            double k[4][2], p = a, q = b;
            for (int j = 0; j < 4; j++) {
                k[j][0] = q, k[j][1] = m * (1 - p * p) * q - p;
                double w = j < 2 ? d / 2 : d;
                p = a + w * k[j][0], q = b + w * k[j][1];
            }
            a += d / 6 * (k[0][0] + 2 * k[1][0] + 2 * k[2][0] + k[3][0]);
            b += d / 6 * (k[0][1] + 2 * k[1][1] + 2 * k[2][1] + k[3][1]);
        }
        v[X0] = a, v[X1] = b;""",
    ),
    # x' = -k x by explicit Euler, so that x(n h) = (1 - k h)^n.
    "Dahlquist": Model([state("x", "1.0"), Var("k", "parameter", "1.0")], "v[X] -= v[K] * v[X] * h;", step_size="0.1"),
    "Stateless": Model([U, Var("x", "output")], "v[X] += v[U] * h;", has_state=False),
    "Failing": Model(
        [Var("x", "output"), Var("t_end", "parameter", "0.5")],
        'v[X] = t; if (t > v[T_END]) error = "the tank is empty";',
        step_size="0.1",
    ),
    "Ending": Model([Var("x", "output")], "v[X] = t; end = t >= 0.45;", step_size="0.1"),
    # x_next = A x + u, in a matrix and vectors.
    "Linear": Model(
        [
            Var("A", "parameter", "0.9 0.1 0 0 0.8 0.2", shape=(2, 3)),
            Var("u", "input", "0 0", shape=(2,)),
            Var("y", "output", shape=(3,)),
        ],
        """double y0 = v[Y], y1 = v[Y + 1], y2 = v[Y + 2];
        for (int i = 0; i < 2; i++) {
            double *row = v + A + 3 * i;
            v[Y + i] = row[0] * y0 + row[1] * y1 + row[2] * y2 + v[U + i];
        }
        v[Y + 2] = y2 + 1;""",
    ),
    "Types": Model(
        [
            Var("whole", "input", "0", "Int32"),
            Var("small", "input", "0", "UInt8"),
            Var("flag", "input", "false", "Boolean"),
            Var("gear", "input", "1", "Enumeration", 'declaredType="Gear"'),
            Var("single", "input", "0", "Float32"),
            Var("twice", "output", type="Int64"),
            Var("inverse", "output", type="Boolean"),
            Var("next", "output", type="Enumeration", attributes='declaredType="Gear"'),
            Var("half", "output", type="Float32"),
            Var("label", "parameter", "none", "String"),
        ],
        "v[TWICE] = 2 * v[WHOLE] + v[SMALL], v[INVERSE] = !v[FLAG], v[NEXT] = v[GEAR] + 1, v[HALF] = v[SINGLE] / 2;",
    ),
    # For the test that counts its instances.
    "Counted": Model([state("x", "0")], "v[X] += h;"),
    "Broken": Model([state("x", "0")], "extern double nobody; v[X] += nobody;"),
    "Foreign": Model([Var("x", "output")], "", platform="x86_64-windows"),
    "Exchange": Model([Var("x", "output")], "", interface="ModelExchange"),
    "Integrator2": Model(
        [Var("u", "input", "0", "Real"), Var("n", "input", "0", "Integer"), Var("on", "input", "1", "Boolean"),
         Var("x", "output", type="Real"), Var("k", "parameter", "2.0", "Real")],
        "if (v[ON]) v[X] += v[K] * (v[U] + v[N]) * h;",
        version=2,
    ),
}  # fmt: skip

TYPES = {
    "Float64": "double",
    "Float32": "float",
    "Boolean": "_Bool",
    "Enumeration": "int64_t",
    "String": "const char *",
}
TYPES |= {f"{s}{n}": f"{s.lower()}{n}_t" for s in ("Int", "UInt") for n in (8, 16, 32, 64)}

COMMON = """
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
typedef struct { double v[SIZE + 1]; void *environment; void *log; void *name; } Instance;
static const char *step(double *v, double t, double h, int *ended) {
    const char *error = 0;
    int end = 0;
    STEP
    *ended = end;
    return error;
}
static Instance *made(void *environment, void *log, const char *name) {
    static const double start[] = {START};
    Instance *instance = calloc(1, sizeof(Instance));
    memcpy(instance->v, start, sizeof(start));
    instance->environment = environment, instance->log = log, instance->name = strdup(name);
    return instance;
}
static void freed(Instance *instance) {
    FILE *file = getenv("FREED") ? fopen(getenv("FREED"), "a") : 0;
    if (file) fprintf(file, "%s\\n", (char *)instance->name), fclose(file);
    free(instance->name), free(instance);
}
"""

FMI3 = """
typedef void (*Log)(void *, int, const char *, const char *);
void *fmi3InstantiateCoSimulation(const char *n, const char *t, const char *r, _Bool a, _Bool b, _Bool c, _Bool d,
                                  const uint32_t *e, size_t f, void *environment, Log log, void *u) {
    return made(environment, (void *)log, n);
}
void fmi3FreeInstance(void *i) { freed(i); }
const char *fmi3GetVersion(void) { return "3.0"; }
#define ACCESS(TYPE, C)                                                                                  \\
    int fmi3Get##TYPE(Instance *i, const uint32_t *r, size_t n, C *x, size_t m) {                        \\
        for (size_t k = 0; k < n; k++)                                                                   \\
            for (int j = 0; j < length[r[k]]; j++) *x++ = i->v[first[r[k]] + j];                         \\
        return 0;                                                                                        \\
    }                                                                                                    \\
    int fmi3Set##TYPE(Instance *i, const uint32_t *r, size_t n, const C *x, size_t m) {                  \\
        for (size_t k = 0; k < n; k++)                                                                   \\
            for (int j = 0; j < length[r[k]]; j++) i->v[first[r[k]] + j] = *x++;                         \\
        return 0;                                                                                        \\
    }
ACCESS(Float64, double) ACCESS(Float32, float) ACCESS(Boolean, _Bool) ACCESS(Int8, int8_t) ACCESS(UInt8, uint8_t)
ACCESS(Int16, int16_t) ACCESS(UInt16, uint16_t) ACCESS(Int32, int32_t) ACCESS(UInt32, uint32_t)
ACCESS(Int64, int64_t) ACCESS(UInt64, uint64_t)
int fmi3SetString(Instance *i, const uint32_t *r, size_t n, const char **x, size_t m) {
    i->v[first[r[0]]] = strlen(x[0]);
    return 0;
}
int fmi3Reset(Instance *i) {
    Instance *other = made(0, 0, "");
    memcpy(i->v, other->v, sizeof(i->v));
    free(other->name), free(other);
    return 0;
}
int fmi3GetFMUState(Instance *i, void **s) {
    *s = memcpy(malloc(sizeof(i->v)), i->v, sizeof(i->v));
    return 0;
}
int fmi3SetFMUState(Instance *i, void *s) {
    memcpy(i->v, s, sizeof(i->v));
    return 0;
}
int fmi3FreeFMUState(Instance *i, void **s) {
    free(*s), *s = 0;
    return 0;
}
int fmi3SerializedFMUStateSize(Instance *i, void *s, size_t *n) {
    *n = sizeof(i->v);
    return 0;
}
int fmi3SerializeFMUState(Instance *i, void *s, uint8_t *bytes, size_t n) {
    memcpy(bytes, s, n);
    return 0;
}
int fmi3DeserializeFMUState(Instance *i, const uint8_t *bytes, size_t n, void **s) {
    *s = memcpy(malloc(n), bytes, n);
    return 0;
}
int fmi3DoStep(Instance *i, double t, double h, _Bool a, _Bool *event, _Bool *end, _Bool *early, double *last) {
    int ended;
    const char *error = step(i->v, t, h, &ended);
    *event = *early = 0, *end = ended, *last = t + h;
    if (error) ((Log)i->log)(i->environment, 3, "logStatusError", error);
    return error ? 3 : 0;
}
"""
FMI2 = """
typedef struct { void (*logger)(void *, const char *, int, const char *, const char *, ...); } Callbacks;
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, const Callbacks *f, int a, int b) {
    return made(0, (void *)f->logger, n);
}
void fmi2FreeInstance(void *i) { freed(i); }
#define ACCESS(TYPE, C)                                                                                       \\
    int fmi2Get##TYPE(Instance *i, const unsigned *r, size_t n, C *x) {                                       \\
        for (size_t k = 0; k < n; k++) x[k] = i->v[first[r[k]]];                                              \\
        return 0;                                                                                             \\
    }                                                                                                         \\
    int fmi2Set##TYPE(Instance *i, const unsigned *r, size_t n, const C *x) {                                 \\
        for (size_t k = 0; k < n; k++) i->v[first[r[k]]] = x[k];                                              \\
        return 0;                                                                                             \\
    }
ACCESS(Real, double) ACCESS(Integer, int) ACCESS(Boolean, int)
int fmi2Reset(Instance *i) {
    Instance *other = made(0, 0, "");
    memcpy(i->v, other->v, sizeof(i->v));
    free(other->name), free(other);
    return 0;
}
int fmi2GetFMUstate(Instance *i, void **s) {
    *s = memcpy(malloc(sizeof(i->v)), i->v, sizeof(i->v));
    return 0;
}
int fmi2SetFMUstate(Instance *i, void *s) {
    memcpy(i->v, s, sizeof(i->v));
    return 0;
}
int fmi2FreeFMUstate(Instance *i, void **s) {
    free(*s), *s = 0;
    return 0;
}
int fmi2SerializedFMUstateSize(Instance *i, void *s, size_t *n) {
    *n = sizeof(i->v);
    return 0;
}
int fmi2SerializeFMUstate(Instance *i, void *s, char *bytes, size_t n) {
    memcpy(bytes, s, n);
    return 0;
}
int fmi2DeSerializeFMUstate(Instance *i, const char *bytes, size_t n, void **s) {
    *s = memcpy(malloc(n), bytes, n);
    return 0;
}
int fmi2DoStep(Instance *i, double t, double h, int a) {
    int ended;
    return step(i->v, t, h, &ended) ? 3 : 0;
}
"""
GEARS = """<TypeDefinitions><EnumerationType name="Gear">
<Item name="one" value="1"/><Item name="two" value="2"/></EnumerationType></TypeDefinitions>"""
# What is called and has nothing to do returns 0.
CALLED = ("EnterInitializationMode", "ExitInitializationMode", "SetupExperiment", "Terminate", "SetDebugLogging")


def source(model: Model) -> str:
    """The C code of a model."""
    sizes = [_size(variable) for variable in model.variables]
    first = [sum(sizes[:k]) for k in range(len(sizes))]
    names = "".join(f"enum {{ {v.name.upper()} = {at} }};\n" for v, at in zip(model.variables, first, strict=True))
    start = [word for v in model.variables for word in _start(v)]
    front = FMI3 if model.version == 3 else FMI2
    prefix = f"fmi{model.version}"
    kind = fmpy.fmi3.FMU3Slave if model.version == 3 else fmpy.fmi2.FMU2Slave
    every = [name for name in dir(kind) if name.startswith(prefix)]
    there = [name for name in every if f"{name}(" in front]
    accessed = TYPES.keys() - {"String"} if model.version == 3 else {"Real", "Integer", "Boolean"}
    there += [f"{prefix}{do}{kind}" for do in ("Get", "Set") for kind in accessed]
    others = "".join(
        f"int {name}(void) {{ return {0 if name[4:] in CALLED else 3}; }}\n" for name in {*every} - {*there}
    )
    common = COMMON.replace("SIZE", str(sum(sizes) + model.hidden)).replace("START", ", ".join(start) or "0")
    tables = (
        f"static const int first[] = {{{', '.join(map(str, first))}}}, length[] = {{{', '.join(map(str, sizes))}}};\n"
    )
    return names + common.replace("STEP", model.step) + tables + front + others


def _size(variable: Var) -> int:
    size = 1
    for length in variable.shape:
        size *= length
    return size


def _start(variable: Var) -> list[str]:
    if variable.type == "String" or not variable.start:
        return ["0"] * _size(variable)
    return [{"true": "1", "false": "0"}.get(word, word) for word in variable.start.split()]


def description(name: str, model: Model) -> str:
    """The text of modelDescription.xml."""
    state = "FMUState" if model.version == 3 else "FMUstate"
    flags = f'canGetAndSet{state}="true" canSerialize{state}="true"'
    simulated = f'<{model.interface} modelIdentifier="{name}" {flags if model.has_state else ""}/>'
    rows = []
    for k, v in enumerate(model.variables):
        is_text = v.type == "String"
        start = f' start="{v.start}"' if v.start and not is_text else ""
        inner = "".join(f'<Dimension start="{length}"/>' for length in v.shape)
        inner += f'<Start value="{v.start}"/>' if is_text else ""
        variability = (
            ""
            if v.type in ("Float64", "Float32", "Real") or "variability" in v.attributes
            else 'variability="discrete"'
        )
        if v.causality == "parameter":
            variability = "" if "variability" in v.attributes else 'variability="fixed"'
        attributes = f'name="{v.name}" valueReference="{k}" causality="{v.causality}" {variability} {v.attributes}'
        if model.version == 3:
            rows.append(f"<{v.type} {attributes}{start}>{inner}</{v.type}>")
        else:
            rows.append(f"<ScalarVariable {attributes}><{v.type}{start}/></ScalarVariable>")
    token = "guid" if model.version == 2 else "instantiationToken"
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="{model.version}.0" modelName="{name}" '
        f'{token}="{name}">{simulated}{GEARS if model.version == 3 else ""}'
        f'<DefaultExperiment stepSize="{model.step_size}"/><ModelVariables>{"".join(rows)}</ModelVariables>'
        "<ModelStructure/></fmiModelDescription>"
    )


@cache
def compiled(folder: Path, name: str) -> Path:
    """The FMU of a model, written into a folder."""
    model = MODELS[name]
    c_file, library, path = folder / f"{name}.c", folder / f"{name}.so", folder / f"{name}.fmu"
    c_file.write_text(source(model))
    command = [
        *compiler_command(),
        "-w",
        "-shared",
        "-fPIC",
        "-ffp-contract=off",
        str(c_file),
        "-o",
        str(library),
        "-lm",
    ]
    subprocess.run(command, check=True)
    platform = model.platform or ("linux64" if model.version == 2 else fmpy.platform_tuple)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description(name, model))
        archive.write(library, f"binaries/{platform}/{name}.{'dll' if model.platform else 'so'}")
    return path
