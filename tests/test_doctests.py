"""Every example in a docstring of sceneprior runs and says what it says."""

import doctest
import importlib
import pkgutil

import sceneprior


def test_docstring_examples():
    names = [
        module.name
        for module in pkgutil.walk_packages(sceneprior.__path__, "sceneprior.")
        if not module.name.endswith("__main__")
    ]
    results = {name: doctest.testmod(importlib.import_module(name)) for name in names}
    assert not [name for name, result in results.items() if result.failed]
    having = {name for name, result in results.items() if result.attempted}
    assert {"sceneprior.silhouettes.render", "sceneprior.offscreen.zbuffer"} <= having
