import jax
import jax.numpy as jnp

import pk_jax as pk


class Delta(pk.Mechanism):
    """Three arms, three rods, a platform that only translates. Pose (x, y, z), joints the arms' angles."""

    base_radius: jax.Array
    platform_radius: jax.Array
    arm: jax.Array
    rod: jax.Array
    joint_units = (0, 0, 0)

    def ring(self, radius, height=0.0):
        x, y = jnp.array([1, -0.5, -0.5]), jnp.sqrt(3) / 2 * jnp.array([0, 1, -1])
        return jnp.stack([radius * x, radius * y, height + 0 * x], axis=1)

    def elbows(self, joints):
        return self.ring(self.base_radius + self.arm * jnp.cos(joints), -self.arm * jnp.sin(joints))

    def residual(self, pose, joints):
        return jnp.sum((pose + self.ring(self.platform_radius) - self.elbows(joints)) ** 2, 1) - self.rod**2

    def home(self):
        across = self.base_radius + self.arm - self.platform_radius
        return jax.lax.stop_gradient(jnp.array([0, 0, -1]) * jnp.sqrt(self.rod**2 - across**2)), jnp.zeros(3)

    def length(self):
        return self.rod

    def margins(self, pose, joints):
        return {"arms": 1 - jnp.abs(joints) / (jnp.pi / 2)}

    def skeleton(self, pose, joints):
        points = [self.ring(self.base_radius), self.elbows(joints), pose + self.ring(self.platform_radius)]
        bars = (*((i, i + 3) for i in range(6)), (6, 7), (7, 8), (8, 6))
        return pk.Skeleton(jnp.concatenate(points), bars, ground=(0, 1, 2))
