"""Pickled classes of the main program, including those derived from Drake's, in another process."""

import pickle
import subprocess
import sys
from dataclasses import MISSING, dataclass, field, fields

import pydrake.symbolic
import pytest
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph

from vtbdrake.common.pickling import dumps

DEFINE = """
import abc, sys
from pydrake.autodiffutils import AutoDiffXd
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, LeafSystem_
from vtbdrake.common.pickling import dumps

class Leaf(LeafSystem):
    size = 2
    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("u", self.size)

class Derived(Leaf):
    size = 3

class Inner(Diagram):
    def __init__(self):
        super().__init__()
        builder = DiagramBuilder()
        leaf = builder.AddNamedSystem("leaf", Derived())
        builder.ExportInput(leaf.get_input_port(), "u")
        builder.BuildInto(self)

class Twice(LeafSystem_[AutoDiffXd]):
    def __init__(self):
        LeafSystem_[AutoDiffXd].__init__(self)
        self.DeclareVectorInputPort("u", 4)

class Abstract(abc.ABC):
    @abc.abstractmethod
    def size(self): ...

class Concrete(Abstract):
    def size(self):
        return 5

sys.stdout.buffer.write(dumps(({expression}, type({expression}))))
"""

READ = """
import pickle, sys
made, kind = pickle.loads(sys.stdin.buffer.read())
print(made().{call}, type(made) is kind, made.__module__)
"""


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("expression", "call", "expected"),
    [
        ("Leaf", "get_input_port().size()", "2"),
        ("Derived", "get_input_port().size()", "3"),
        ("Inner", "get_input_port().size()", "3"),
        ("Twice", "get_input_port().size()", "4"),
        ("Concrete", "size()", "5"),
    ],
)
def test_class_of_the_main_program_is_rebuilt_elsewhere(expression, call, expected):
    define = DEFINE.format(expression=expression)
    sent = subprocess.run([sys.executable, "-c", define], capture_output=True, timeout=60, check=True).stdout
    read = subprocess.run(
        [sys.executable, "-c", READ.format(call=call)], input=sent, capture_output=True, timeout=60, check=True
    )
    assert read.stdout.decode().split() == [expected, "True", "__main__"]


def test_dataclass_can_be_derived_from_after_its_class_was_sent():
    @dataclass
    class Base:  # sent by value, as classes of the main program are
        numbers: list[int] = field(default_factory=list)

    assert type(pickle.loads(dumps(Base()))) is Base

    @dataclass
    class Derived(Base):
        size: int = 3

    assert Derived() == Derived(numbers=[], size=3)
    assert [entry.default is MISSING for entry in fields(Derived)] == [True, False]


@pytest.mark.parametrize("function", [AddMultibodyPlantSceneGraph, InitializeAutoDiff, pydrake.symbolic.min])
def test_functions_of_drake_that_a_script_imports_are_sent(function):
    law = eval("lambda: function", {"function": function, "__name__": "__main__"})
    assert pickle.loads(dumps(law))() is function
