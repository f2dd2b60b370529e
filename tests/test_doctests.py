"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib
import pkgutil

import data_prep
import sceneprior


def test_docstring_examples():
    names = [
        module.name
        for package in (sceneprior, data_prep)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not module.name.endswith("__main__")
    ]
    results = {name: doctest.testmod(importlib.import_module(name)) for name in names}
    assert not [name for name, result in results.items() if result.failed]
    having = {name for name, result in results.items() if result.attempted}
    assert {
        "sceneprior.apps.api",
        "sceneprior.render.silhouettes.render",
        "sceneprior.render.offscreen.zbuffer",
        "data_prep.front.views",
    } <= having
