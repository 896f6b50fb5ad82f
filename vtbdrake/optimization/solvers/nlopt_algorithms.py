"""The algorithms of NLopt that Drake's build of it can run, by NLopt's own names.

The first letter says global or local, the second says whether it uses derivatives (D) or not (N). Not offered, though
Drake lists them: those of Luksan (LD_LBFGS, LD_VAR1, LD_VAR2, LD_TNEWTON...), which its build leaves out, and those
that need a second algorithm inside (AUGLAG, AUGLAG_EQ, G_MLSL, G_MLSL_LDS), which Drake cannot name: they return at
once with x = nan. Nor is LN_NEWUOA_BOUND, which can compute for ever without a call of the function, and holds Python's
lock meanwhile (LN_BOBYQA is its successor), nor GN_ORIG_DIRECT and GN_ORIG_DIRECT_L, which crash the process with drake
1.58 (GN_DIRECT and GN_DIRECT_L are the same methods).

https://nlopt.readthedocs.io/en/latest/NLopt_Algorithms/
"""

from __future__ import annotations

DERIVATIVE_FREE = (
    "GN_AGS",
    "GN_CRS2_LM",
    "GN_DIRECT",
    "GN_DIRECT_L",
    "GN_DIRECT_L_NOSCAL",
    "GN_DIRECT_L_RAND",
    "GN_DIRECT_L_RAND_NOSCAL",
    "GN_DIRECT_NOSCAL",
    "GN_ESCH",
    "GN_ISRES",
    "GN_MLSL",
    "GN_MLSL_LDS",
    "LN_AUGLAG",
    "LN_AUGLAG_EQ",
    "LN_BOBYQA",
    "LN_COBYLA",
    "LN_NELDERMEAD",
    "LN_NEWUOA",
    "LN_PRAXIS",
    "LN_SBPLX",
)

WITH_DERIVATIVES = (
    "GD_MLSL",
    "GD_MLSL_LDS",
    "GD_STOGO",
    "GD_STOGO_RAND",
    "LD_AUGLAG",
    "LD_AUGLAG_EQ",
    "LD_CCSAQ",
    "LD_MMA",
    "LD_SLSQP",
)

# LD_MMA takes constraints too, and so do LD_AUGLAG_EQ, which works with it inside;
# but on smooth functions of two variables under a linear constraint they report success far from the optimum. Others
# refuse them.
WITH_CONSTRAINTS = frozenset(
    {
        "GN_AGS",
        "GN_ISRES",
        "LD_AUGLAG",
        "LD_CCSAQ",
        "LD_SLSQP",
        "LN_AUGLAG",
        "LN_AUGLAG_EQ",
        "LN_COBYLA",
    }
)

# PRAXIS goes round in circles on one parameter, and NEWUOA refuses it.
SEVERAL_PARAMETERS = frozenset({"LN_NEWUOA", "LN_PRAXIS"})

# NLopt seeds its random numbers from the clock, and Drake has no way to seed them.
SEEDED_BY_CLOCK = frozenset(
    {
        "GD_MLSL",
        "GD_STOGO_RAND",
        "GN_CRS2_LM",
        "GN_DIRECT_L_RAND",
        "GN_DIRECT_L_RAND_NOSCAL",
        "GN_ESCH",
        "GN_ISRES",
        "GN_MLSL",
        "LN_PRAXIS",
    }
)

# These end at a number of evaluations only, and report success there.
UNTIL_LIMIT = frozenset({"GD_STOGO", "GD_STOGO_RAND"})

# These do not survive an exception in their callback: they go on for ever, or crash the process. When they are closed,
# they are given the same value everywhere instead, and run to their end or to the limit of their calls: the budget, or
# this number without one.
NO_EXCEPTIONS = frozenset({"GD_STOGO", "GD_STOGO_RAND", "LN_NEWUOA"})
LIMIT = 5_000

# How NLopt names the number that it returns.
RESULTS = {
    1: "SUCCESS",
    2: "STOPVAL_REACHED",
    3: "FTOL_REACHED",
    4: "XTOL_REACHED",
    5: "MAXEVAL_REACHED",
    6: "MAXTIME_REACHED",
    0: "NO RESULT",
    -1: "FAILURE",
    -2: "INVALID_ARGS",
    -3: "OUT_OF_MEMORY",
    -4: "ROUNDOFF_LIMITED",
    -5: "FORCED_STOP",
}
