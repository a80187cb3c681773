"""Differentiable kinematics of parallel mechanisms in JAX."""

from typing import Any

from pk_jax.analysis.indices import LocalIndices as LocalIndices
from pk_jax.analysis.indices import local_indices as local_indices
from pk_jax.analysis.workspace import IndexErrors as IndexErrors
from pk_jax.analysis.workspace import WorkspaceIndices as WorkspaceIndices
from pk_jax.analysis.workspace import workspace_indices as workspace_indices
from pk_jax.design.objective import IndexBounds as IndexBounds
from pk_jax.design.objective import composite_index as composite_index
from pk_jax.design.optimize import DesignResult as DesignResult
from pk_jax.design.optimize import index_bounds as index_bounds
from pk_jax.design.optimize import optimize_design as optimize_design
from pk_jax.design.variables import DesignSpace as DesignSpace
from pk_jax.design.variables import design_space as design_space
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
from pk_jax.mechanisms.catalogue import catalogued as catalogued
from pk_jax.mechanisms.five_bar import FiveBar as FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR as TwoRPR
from pk_jax.precision import enable_x64 as enable_x64
from pk_jax.status import Status as Status


def draw(mech: Mechanism, pose: Any, joints: Any, ax: Any = None, **line: Any) -> Any:
    """Draw a mechanism from its skeleton; see `pk_jax.viz.skeleton.draw`. Imports matplotlib."""
    from pk_jax.viz.skeleton import draw

    return draw(mech, pose, joints, ax, **line)
