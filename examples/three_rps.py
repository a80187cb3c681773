import jax
import jax.numpy as jnp

import pk_jax as pk


class ThreeRPS(pk.ExplicitMechanism):
    """Three telescopic legs, on hinges below and ball joints above, lift and tilt a platform.

    Pose (z, a, b): the height of the platform's centre, and a turn about the horizontal axis (a, b) by the
    angle t with 2 tan(t / 2) = |(a, b)|. Each hinge keeps its leg in an upright plane through the middle of
    the base. Hence the platform never twists (Bonev 2002), and its centre is drawn aside where it tilts. The
    other operation mode, half a turn about a slanted axis (Schadlbauer, Walter, Husty 2014), is left out.
    """

    base_radius: jax.Array
    platform_radius: jax.Array
    stroke: jax.Array  # (2,) least and greatest length of a leg
    most_tilt: jax.Array  # rad
    pose_units, joint_units = (1, 0, 0), (1, 1, 1)
    joints_are_distances, angles_come_round = True, False

    def check_values(self):
        if not 0 < self.stroke[0] < self.stroke[1]:
            raise ValueError(f"ThreeRPS.stroke must be 0 < least < greatest, got {self.stroke.tolist()}")

    def out(self):
        return jnp.array([[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]])

    def tips(self, pose):  # where the legs meet the platform, a row each
        z, a, b = pose
        cross = jnp.array([[0, 0, b], [0, 0, -a], [-b, a, 0]])
        turn = jnp.eye(3) + (cross + cross @ cross / 2) / (1 + (a**2 + b**2) / 4)
        aside = self.platform_radius * jnp.array([(turn[0, 0] - turn[1, 1]) / 2, -turn[0, 1]])
        return jnp.append(aside, z) + self.platform_radius * self.out() @ turn.T

    def residual(self, pose, joints):
        return jnp.sum((self.tips(pose) - self.base_radius * self.out()) ** 2, axis=1) - joints**2

    def home(self):
        leg, aside = jnp.mean(self.stroke), self.base_radius - self.platform_radius
        return jax.lax.stop_gradient(jnp.array([1, 0, 0]) * jnp.sqrt(leg**2 - aside**2)), leg * jnp.ones(3)

    def length(self):
        return self.base_radius

    def margins(self, pose, joints):
        short, long = (joints - self.stroke[0]) / self.length(), (self.stroke[1] - joints) / self.length()
        steep = jnp.tan(self.most_tilt / 2) ** 2
        return {"short": short, "long": long, "tilt": 1 - (pose[1] ** 2 + pose[2] ** 2) / 4 / steep}

    def skeleton(self, pose, joints):
        points = jnp.concatenate([self.base_radius * self.out(), self.tips(pose)])
        return pk.Skeleton(points, ((0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)), ground=(0, 1, 2))


robot = ThreeRPS(base_radius=0.3, platform_radius=0.2, stroke=[0.5, 0.8], most_tilt=0.7)
