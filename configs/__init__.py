"""One preset per domain. `preset(name)` is what a command starts from; any field can then be changed by its flag."""

import importlib

from mijax.config import Config

DOMAINS = ("heaven_hell", "sphinx", "carflag_2d")
"""Domains that can be trained: CI tries each, the bench measures each."""
ROBOTS = ("block_pulling", "block_pushing", "drawer_opening")
"""Domains with continuous actions: their presets wait for SAC."""


def preset(domain: str) -> Config:
    """The preset of a domain; a domain without one (a user's own) gets the defaults under its name."""
    if domain not in (*DOMAINS, *ROBOTS):
        return Config(domain=domain)
    return importlib.import_module(f"configs.{domain}").CONFIG
