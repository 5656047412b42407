"""One preset per domain. `preset(name)` is what a command starts from; any field can then be changed by its flag."""

import dataclasses
import importlib

from envs_mjx.registry import plain_name
from mijax.config import Config

DOMAINS = ("heaven_hell", "sphinx", "carflag_2d")
"""Domains with discrete actions, trained by Double DQN: CI tries each, the bench measures each."""
ROBOTS = ("block_pulling", "block_pushing", "drawer_opening")
"""Domains with continuous actions, trained by SAC."""


def preset(domain: str) -> Config:
    """The preset of a domain, whatever its arguments; one without (a user's own) gets the defaults under its name."""
    name = plain_name(domain)
    if name not in (*DOMAINS, *ROBOTS):
        return Config(domain=domain)
    return dataclasses.replace(importlib.import_module(f"configs.{name}").CONFIG, domain=domain)
