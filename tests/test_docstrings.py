"""The examples in docstrings of the names at the top of the package are true."""

import doctest
import importlib

import pytest

MODULES = (
    "contactgraph.cli.models",
    "contactgraph.envs.registry",
    "contactgraph.control.cost",
    "contactgraph.control.ilqr",
    "contactgraph.control.mpc",
    "contactgraph.data.dataset_file",
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_are_true(name: str) -> None:
    failed, tried = doctest.testmod(importlib.import_module(name))
    assert tried, "the module must have an example"
    assert not failed
