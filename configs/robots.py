"""What the presets of the three robot tasks share (paper Appendix B.4, Tables 2 and 3).

The budget is the paper's: 800 episodes of 50 steps, 80 demonstrations of the scripted expert in the replay from the
start, every episode sampled as it was or in one of 24 turned copies, half of them mirrored (the paper's four turned
ones are learnt by heart). Updates are cheap: frames are looked at once, by psi's body, for every agent alike (six
times the speed), there is half an update for each step, with returns that reach further back, and no dropout, so that
one pass serves gradients and targets. Every agent begins on the demonstrations alone and imitates them, less and less
(on Drawer-Opening and Block-Pushing more slowly, and its own successes too): without, none learns to change over, as
the critics tell a demonstration by its history and not by its actions. Stage 1 sees copies of each demonstrated
transition as Table 3 has them, for a budget of minutes. On Drawer-Opening and Block-Pushing DIM leaves out of z_o where
things are; there z_o is asked for it. Measurements: results/robots.
"""

from mijax.config import (
    Config,
    EvaluationConfig,
    InformationConfig,
    LowerBound,
    NetworkConfig,
    SACConfig,
    SelfPredictionConfig,
    Stage1Config,
)


def robot(
    domain: str, copies: int, epochs: int, lambda_club: float = 0.3, lower_bound: LowerBound = "jensen_shannon",
    steps: int = 40_000, imitation_until: float = 0.5, imitation_final: float = 0.1, imitate_successes: bool = False,
) -> Config:
    """The preset of a robot task.

    Args:
        domain: its name.
        copies: of every demonstrated transition in stage 1 (Table 3).
        epochs: of stage 1.
        lambda_club: at its full weight; 0.3 left nothing of z_s in Block-Pushing.
        lower_bound: of I(o; z_o), "variables" where DIM leaves the places of objects out of z_o.
        steps: of the environment.
        imitation_until: fraction of the run over which imitation fades.
        imitation_final: what it fades to.
        imitate_successes: whether the agent's own successes are imitated too.
    """
    return Config(
        domain=domain,
        steps=steps,
        num_envs=2,
        stage1=Stage1Config(data="demonstrations", episodes=80, heldout_episodes=80, copies=copies, epochs=epochs,
                            batch_size=100, learning_rate=2e-3, rewarded=20, lambda_r=10.0, lambda_s=0.1, lambda_o=1.0,
                            lambda_club=lambda_club, club_ramp=0.8, warmup=0.1, lambda_dim_s=0.1, lambda_dim_o=1.0,
                            lower_bound=lower_bound, phi_shrinkage=0.0),
        network=NetworkConfig(action_embedding=16, observation_embedding=64, dropout=0.0),
        sac=SACConfig(trunk="psi", learning_rate=1e-3, final_learning_rate=0.05, trace_decay=0.8, target_rate=0.01,
                      updates_per_step=0.5, replay_steps=50_000, demonstrations=80, demonstration_share=0.25,
                      pretrain_updates=2000, imitation_weight=2.0, imitation_until=imitation_until,
                      imitation_final=imitation_final, imitate_successes=imitate_successes, rotated_copies=24),
        zp=SelfPredictionConfig(weight=0.1),
        # The paper's weight of 0.1 paid up to 0.35 for an episode of moving about, as z_s holds what moves too: a
        # solved agent went back from 1.0 to 0.44 within 10 000 steps.
        information=InformationConfig(auxiliary_weight=0.5, intrinsic_weight=0.02, intrinsic_form="cosine"),
        evaluation=EvaluationConfig(every=500, episodes=10),
    )
