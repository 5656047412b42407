"""One preset per domain. `preset(name)` is what a command starts from; any field can then be changed by its flag."""

import importlib

from mijax.config import Config

DOMAINS = ("heaven_hell", "sphinx", "carflag_2d")


def preset(domain: str) -> Config:
    """The preset of a domain; a domain without one (a user's own) gets the defaults under its name."""
    if domain not in DOMAINS:
        return Config(domain=domain)
    return importlib.import_module(f"configs.{domain}").CONFIG
