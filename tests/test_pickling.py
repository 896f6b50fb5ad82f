"""Pickled classes of the main program, including those derived from Drake's, in another process."""

import subprocess
import sys

import pytest

DEFINE = """
import abc, sys
from pydrake.autodiffutils import AutoDiffXd
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, LeafSystem_
from vtbdrake.pickling import dumps

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
