"""A module whose import lasts."""

from tests.cli.lasting import last

last("it is being imported")
