"""Imports every module with deprecations as errors, so that they fail `make check` and never a user."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import warnings

PACKAGES = ("vical_daemon", "vical_drivers", "vical_mocks")

for category in (DeprecationWarning, PendingDeprecationWarning):
    warnings.simplefilter("error", category)
failed = []
for name in PACKAGES:
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, f"{name}."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except Exception as error:
            failed.append(f"{module.name}: {type(error).__name__}: {error}")
sys.exit("\n".join(failed) or None)
