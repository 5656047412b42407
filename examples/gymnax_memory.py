"""bsuite's memory chain as gymnax has it: a bit is shown once, and asked for five steps later.

    pip install -e '.[adapters]'
    python -m mijax.train --domain examples.gymnax_memory:MemoryChain --steps 30000
"""

import gymnax

from envs_mjx.adapters.gymnax import FromGymnax


class MemoryChain(FromGymnax):
    """The privileged state: the bit, which bit is asked for, and the time."""

    def __init__(self) -> None:
        env, params = gymnax.make("MemoryChain-bsuite")
        super().__init__(env, params, horizon=10, fields=("context", "query", "time"), hidden=("context",))
