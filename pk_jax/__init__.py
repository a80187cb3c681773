"""Differentiable kinematics of parallel mechanisms in JAX."""

from pk_jax.kinematics.forward import ForwardKinematics as ForwardKinematics
from pk_jax.kinematics.forward import forward_kinematics as forward_kinematics
from pk_jax.kinematics.inverse import InverseKinematics as InverseKinematics
from pk_jax.kinematics.inverse import inverse_kinematics as inverse_kinematics
from pk_jax.kinematics.jacobian import joint_jacobian as joint_jacobian
from pk_jax.kinematics.jacobian import pose_jacobian as pose_jacobian
from pk_jax.kinematics.jacobian import velocity_jacobian as velocity_jacobian
from pk_jax.kinematics.laws import check_mechanism as check_mechanism
from pk_jax.mechanisms.base import LegMechanism as LegMechanism
from pk_jax.mechanisms.base import Mechanism as Mechanism
from pk_jax.mechanisms.base import Skeleton as Skeleton
from pk_jax.mechanisms.five_bar import FiveBar as FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR as TwoRPR
from pk_jax.precision import enable_x64 as enable_x64
from pk_jax.status import Status as Status
