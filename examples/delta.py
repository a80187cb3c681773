import jax
import jax.numpy as jnp

import pk_jax as pk


class Delta(pk.ExplicitMechanism):
    """Three arms, three rods, a platform that only translates. Pose (x, y, z), joints the arms' angles."""

    base_radius: jax.Array
    platform_radius: jax.Array
    arm: jax.Array
    rod: jax.Array
    joint_units = (0, 0, 0)

    def rings(self, pose, joints):  # shoulders, elbows and ends of the rods, a column each
        out, up = jnp.array([[2, -1, -1], [0, 3**0.5, -(3**0.5)], [0, 0, 0]]) / 2, jnp.eye(3)[:, 2:]
        elbows = (self.base_radius + self.arm * jnp.cos(joints)) * out - self.arm * jnp.sin(joints) * up
        return self.base_radius * out, elbows, pose[:, None] + self.platform_radius * out

    def residual(self, pose, joints):
        _, elbows, ends = self.rings(pose, joints)
        return jnp.sum((ends - elbows) ** 2, axis=0) - self.rod**2

    def home(self):
        across = self.base_radius + self.arm - self.platform_radius
        return jax.lax.stop_gradient(jnp.array([0, 0, -1]) * jnp.sqrt(self.rod**2 - across**2)), jnp.zeros(3)

    def length(self):
        return self.rod

    def margins(self, pose, joints):
        return {"arms": 1 - jnp.abs(joints) / (jnp.pi / 2), "reach": self.reach(pose)}

    def skeleton(self, pose, joints):
        bars = (*((i, i + 3) for i in range(6)), (6, 7), (7, 8), (8, 6))
        return pk.Skeleton(jnp.concatenate(self.rings(pose, joints), axis=1).T, bars, ground=(0, 1, 2))


robot = Delta(base_radius=0.2, platform_radius=0.05, arm=0.35, rod=0.8)
