"""Lists of all observations, and images taken apart, against the plain encoders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx import registry
from mijax.config import Config, NetworkConfig
from mijax.frames import FrameTable, Patches, keep_present, take_apart
from mijax.learner import make_learner
from mijax.nets.encoders import encoder_for
from mijax.nets.heads import ObservationEmbedder

FEATURES = 3


def observations(domain: str) -> np.ndarray:
    listed = registry.make(domain).all_observations()
    if listed is None:
        pytest.skip("the environment lists none")
    return listed


def test_frames_that_are_there_are_kept_once():
    index = jnp.array([7, 2, 7, 5, 2])
    few, present, place = jax.jit(keep_present, static_argnums=(1, 2))(index, 9, 4)
    assert few
    np.testing.assert_array_equal(present[:3], [2, 5, 7])
    np.testing.assert_array_equal(present[place], index)
    assert not keep_present(index, 9, 2)[0]


@pytest.mark.parametrize("dtype", ["uint8", "float32", "float16", "int32", "bool"])
def test_index_of_any_type(dtype: str):
    rng = np.random.default_rng(0)
    frames = np.unique(rng.integers(-1 if dtype[0] in "fi" else 0, 2, (60, 2, 2)).astype(dtype), axis=0)
    order = rng.permutation(len(frames))
    np.testing.assert_array_equal(jax.jit(FrameTable(frames).index_of)(jnp.asarray(frames[order])), order)


def test_index_of_floats_that_differ_in_their_last_bit():
    frames = np.array([[1.0, 0.0], [np.nextafter(np.float32(1), 2), 0.0]], np.float32)
    seen = np.array([frames[1], frames[0], [1.0, -0.0]], np.float32)
    np.testing.assert_array_equal(FrameTable(frames).index_of(jnp.asarray(seen)), [1, 0, 0])


def test_a_list_with_a_repeated_observation_is_refused():
    with pytest.raises(ValueError, match="not all different"):
        FrameTable(np.array([[0.0], [1.0], [-0.0]]))


@pytest.mark.parametrize("domain", registry.names())
def test_every_listed_observation_is_found(domain: str):
    frames = observations(domain)
    np.testing.assert_array_equal(FrameTable(frames).index_of(jnp.asarray(frames)), np.arange(len(frames)))


@pytest.mark.parametrize("domain", ["sphinx", "carflag_2d"])
@pytest.mark.parametrize("kind", ["psi", "embedder"])
def test_images_taken_apart_are_encoded_alike(domain: str, kind: str):
    """Values and gradients; the batch size that is named decides how many layers work on patches."""
    frames = observations(domain)[::3]
    spec = registry.make(domain).observation_spec
    encoder = encoder_for(spec, FEATURES) if kind == "psi" else ObservationEmbedder(FEATURES)
    layers = encoder.layers_on(spec.shape) if isinstance(encoder, ObservationEmbedder) else encoder.layers
    params = encoder.init(jax.random.key(0), jnp.asarray(frames[:1]))["params"]
    some = jnp.asarray([2, 0, 2, 5])
    weight = jax.random.normal(jax.random.key(1), (4, FEATURES))

    def loss(params, x):
        return jnp.sum(weight * jnp.asarray(encoder.apply({"params": params}, x)))

    expected = jax.jit(jax.value_and_grad(loss))(params, jnp.asarray(frames)[some])
    depths = set()
    for batch in (len(frames), 10**6):
        patches = take_apart(frames, layers, batch)
        assert isinstance(patches, Patches)
        depths.add(len(patches.windows))
        got = jax.jit(jax.value_and_grad(loss))(params, patches.take(some))
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5), got, expected)
    assert max(depths) == len(layers)


def test_images_whose_patches_never_repeat_stay_whole():
    frames = np.random.default_rng(0).integers(0, 256, (20, 6, 6, 2)).astype(np.uint8)
    assert take_apart(frames, ((2, 1), (2, 1)), len(frames)) is None
    assert take_apart(frames, (), len(frames)) is None


def test_the_replay_stores_which_observation_was_seen():
    env = registry.make("carflag_2d")
    config = Config(domain="carflag_2d", agent="base", network=NetworkConfig(observation_embedding=32))
    learner = make_learner(env, config)
    assert learner.observations is not None
    _, timestep = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 5))
    record = jax.jit(learner.recorder(None))(timestep, jnp.zeros(5, jnp.int32))
    assert record.observation.dtype == jnp.int16
    assert record.previous_action.dtype == jnp.int8
    np.testing.assert_array_equal(learner.observations.frames[record.observation], timestep.observation)
