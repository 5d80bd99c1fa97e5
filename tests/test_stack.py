"""The pinned set as a whole: MJX steps as MuJoCo does, and Brax trains on this JAX."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.policies import brax_compat

SPHERE = """
<mujoco>
  <option timestep="0.005" integrator="Euler"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" contype="0" conaffinity="0"/>
    <body pos="0 0 2">
      <freejoint/>
      <geom name="ball" type="sphere" size=".1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact><pair geom1="floor" geom2="ball" condim="1"/></contact>
</mujoco>
"""


@pytest.mark.slow
def test_mjx_drops_a_sphere_as_mujoco_does():
    import mujoco
    from mujoco import mjx

    model = mujoco.MjModel.from_xml_string(SPHERE)
    data = mujoco.MjData(model)
    data.qvel[:3] = [0.5, -0.2, 1.0]
    device_model, start = mjx.put_model(model), mjx.put_data(model, data)
    steps = 200  # rises, falls for 0.75 s, then rests on the floor

    def step(state, _):
        state = mjx.step(device_model, state)
        return state, state.qpos

    _, path = jax.jit(lambda state: jax.lax.scan(step, state, None, steps))(start)
    reference = np.empty((steps, model.nq))
    for row in reference:
        mujoco.mj_step(model, data)
        row[:] = data.qpos
    assert reference[:, 2].min() < 0.1  # the sphere did touch the floor
    np.testing.assert_allclose(path, reference, atol=1e-4)


def one_step_environment():
    """A Brax environment of one step: the reward is minus the squared distance to the answer."""
    from brax.envs.base import Env, State

    class OneStep(Env):
        def reset(self, rng):
            obs = jax.random.uniform(rng, (self.observation_size,), minval=-1.0)
            return State(None, obs, jnp.zeros(()), jnp.zeros(()), {}, {})

        def step(self, state, action):
            reward = -jnp.sum((action - state.obs) ** 2)
            return state.replace(reward=reward, done=jnp.ones(()))

        @property
        def observation_size(self):
            return 2

        @property
        def action_size(self):
            return 2

        @property
        def backend(self):
            return "none"

    return OneStep()


@pytest.mark.slow
def test_brax_takes_a_ppo_update():
    brax_compat.install()
    ppo = importlib.import_module("brax.training.agents.ppo.train")
    networks = importlib.import_module("brax.training.agents.ppo.networks")

    _, (_, policy, _), metrics = ppo.train(
        environment=one_step_environment(),
        num_timesteps=128,  # batch_size * num_minibatches * unroll_length: one update
        episode_length=1,
        num_envs=16,
        num_eval_envs=16,
        num_evals=2,
        batch_size=16,
        num_minibatches=2,
        unroll_length=4,
        num_updates_per_batch=1,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=(8,),
            value_hidden_layer_sizes=(8,),
        ),
        seed=0,
    )
    # The second minibatch is compared with the policy that gathered it: the first one moved it.
    assert metrics["training/kl_mean"] > 0.0
    assert np.isfinite(metrics["training/total_loss"])
    assert metrics["eval/episode_reward"] < 0.0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy))


def test_replicas_are_rows_on_their_devices():
    tree = {"gain": np.arange(3.0, dtype=np.float32), "count": 2}
    replicas = brax_compat.device_put_replicated(tree, jax.local_devices())
    num_devices = jax.local_device_count()
    assert replicas["gain"].shape == (num_devices, 3) and replicas["count"].shape == (num_devices,)
    for shard, device in zip(replicas["gain"].addressable_shards, jax.local_devices(), strict=True):
        assert shard.device == device
        np.testing.assert_array_equal(shard.data[0], tree["gain"])
