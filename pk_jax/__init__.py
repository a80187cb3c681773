"""Differentiable kinematics of parallel mechanisms in JAX.

Importing this package imports nothing else: each public name is looked up in its module at its
first use, so that `pk-jax --help` is instant, and jax configures itself only when it is needed.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pk_jax.analysis.boxes import Certificate as Certificate
    from pk_jax.analysis.certificate import certify_confined as certify_confined
    from pk_jax.analysis.certificate import certify_regular as certify_regular
    from pk_jax.analysis.indices import LocalIndices as LocalIndices
    from pk_jax.analysis.indices import local_indices as local_indices
    from pk_jax.analysis.integral import IntegralGradient as IntegralGradient
    from pk_jax.analysis.integral import WorkspaceIntegral as WorkspaceIntegral
    from pk_jax.analysis.integral import integral_gradient as integral_gradient
    from pk_jax.analysis.integral import workspace_integral as workspace_integral
    from pk_jax.analysis.loci import LocusCurve as LocusCurve
    from pk_jax.analysis.loci import SingularityLocus as SingularityLocus
    from pk_jax.analysis.loci import singularity_locus as singularity_locus
    from pk_jax.analysis.redundancy import Redundancy as Redundancy
    from pk_jax.analysis.redundancy import resolve_redundancy as resolve_redundancy
    from pk_jax.analysis.sensors import NoiseGain as NoiseGain
    from pk_jax.analysis.sensors import NoiseGains as NoiseGains
    from pk_jax.analysis.sensors import SensorLayout as SensorLayout
    from pk_jax.analysis.sensors import noise_gains as noise_gains
    from pk_jax.analysis.sensors import pose_covariance as pose_covariance
    from pk_jax.analysis.sensors import sensor_layout as sensor_layout
    from pk_jax.analysis.singularity import Singularity as Singularity
    from pk_jax.analysis.singularity import SingularityKind as SingularityKind
    from pk_jax.analysis.singularity import classify_singularity as classify_singularity
    from pk_jax.analysis.singularity import singularity_distance as singularity_distance
    from pk_jax.analysis.workspace import IndexErrors as IndexErrors
    from pk_jax.analysis.workspace import WorkspaceIndices as WorkspaceIndices
    from pk_jax.analysis.workspace import workspace_indices as workspace_indices
    from pk_jax.analysis.workspace_map import Travel as Travel
    from pk_jax.analysis.workspace_map import WorkspaceMap as WorkspaceMap
    from pk_jax.analysis.workspace_map import travel as travel
    from pk_jax.analysis.workspace_map import workspace_map as workspace_map
    from pk_jax.control.loop import Simulation as Simulation
    from pk_jax.control.loop import simulate_control as simulate_control
    from pk_jax.control.plant import Gains as Gains
    from pk_jax.control.plant import Plant as Plant
    from pk_jax.control.reference import Reference as Reference
    from pk_jax.control.reference import circle_reference as circle_reference
    from pk_jax.control.reference import step_reference as step_reference
    from pk_jax.design.calibration import Calibration as Calibration
    from pk_jax.design.calibration import calibrate as calibrate
    from pk_jax.design.calibration import stewart_from_log as stewart_from_log
    from pk_jax.design.evaluate import DesignValues as DesignValues
    from pk_jax.design.evaluate import evaluate_designs as evaluate_designs
    from pk_jax.design.families import Family as Family
    from pk_jax.design.families import design_family as design_family
    from pk_jax.design.objective import IndexBounds as IndexBounds
    from pk_jax.design.objective import composite_index as composite_index
    from pk_jax.design.objectives import least_over as least_over
    from pk_jax.design.objectives import margins_over as margins_over
    from pk_jax.design.objectives import over_workspace as over_workspace
    from pk_jax.design.objectives import rectangle as rectangle
    from pk_jax.design.optimize import DesignResult as DesignResult
    from pk_jax.design.optimize import index_bounds as index_bounds
    from pk_jax.design.optimize import optimize_design as optimize_design
    from pk_jax.design.optimum import OptimizedDesign as OptimizedDesign
    from pk_jax.design.pareto import ParetoDesigns as ParetoDesigns
    from pk_jax.design.pareto import ParetoFront as ParetoFront
    from pk_jax.design.pareto import pareto_designs as pareto_designs
    from pk_jax.design.pareto import pareto_front as pareto_front
    from pk_jax.design.pareto import pareto_problem as pareto_problem
    from pk_jax.design.problem import DesignProblem as DesignProblem
    from pk_jax.design.robust import robust as robust
    from pk_jax.design.sensor_placement import SensorPlacement as SensorPlacement
    from pk_jax.design.sensor_placement import place_sensors as place_sensors
    from pk_jax.design.variables import DesignSpace as DesignSpace
    from pk_jax.design.variables import design_space as design_space
    from pk_jax.files.mechanism_file import load_mechanism as load_mechanism
    from pk_jax.files.mechanism_file import save_mechanism as save_mechanism
    from pk_jax.geometry.axis_pose import AxisPose as AxisPose
    from pk_jax.geometry.se3 import SE3 as SE3
    from pk_jax.kinematics.certify import Certified as Certified
    from pk_jax.kinematics.certify import certify as certify
    from pk_jax.kinematics.forward import CertifiedKinematics as CertifiedKinematics
    from pk_jax.kinematics.forward import ForwardKinematics as ForwardKinematics
    from pk_jax.kinematics.forward import forward_kinematics as forward_kinematics
    from pk_jax.kinematics.inverse import InverseKinematics as InverseKinematics
    from pk_jax.kinematics.inverse import inverse_kinematics as inverse_kinematics
    from pk_jax.kinematics.inverse import working_modes as working_modes
    from pk_jax.kinematics.jacobian import joint_jacobian as joint_jacobian
    from pk_jax.kinematics.jacobian import pose_jacobian as pose_jacobian
    from pk_jax.kinematics.jacobian import self_motions as self_motions
    from pk_jax.kinematics.jacobian import velocity_jacobian as velocity_jacobian
    from pk_jax.kinematics.laws import check_mechanism as check_mechanism
    from pk_jax.kinematics.modes.assembly import AssemblyModes as AssemblyModes
    from pk_jax.kinematics.modes.assembly import Fate as Fate
    from pk_jax.kinematics.modes.assembly import assembly_modes as assembly_modes
    from pk_jax.kinematics.modes.roadmap import Connections as Connections
    from pk_jax.kinematics.modes.roadmap import Link as Link
    from pk_jax.kinematics.modes.roadmap import connect_modes as connect_modes
    from pk_jax.kinematics.nine_lengths import NineLengthCandidates as NineLengthCandidates
    from pk_jax.kinematics.nine_lengths import NineLengthPose as NineLengthPose
    from pk_jax.kinematics.nine_lengths import nine_length_candidates as nine_length_candidates
    from pk_jax.kinematics.nine_lengths import nine_length_pose as nine_length_pose
    from pk_jax.kinematics.statics import BoundedForces as BoundedForces
    from pk_jax.kinematics.statics import Screws as Screws
    from pk_jax.kinematics.statics import bounded_joint_forces as bounded_joint_forces
    from pk_jax.kinematics.statics import joint_forces as joint_forces
    from pk_jax.kinematics.statics import platform_wrench as platform_wrench
    from pk_jax.kinematics.statics import preloads as preloads
    from pk_jax.kinematics.statics import screws as screws
    from pk_jax.kinematics.statics import stiffness as stiffness
    from pk_jax.kinematics.track import Track as Track
    from pk_jax.kinematics.track import track as track
    from pk_jax.mechanisms.base import LegMechanism as LegMechanism
    from pk_jax.mechanisms.base import Mechanism as Mechanism
    from pk_jax.mechanisms.base import Skeleton as Skeleton
    from pk_jax.mechanisms.casing_oscillator import CasingOscillator as CasingOscillator
    from pk_jax.mechanisms.catalogue import catalogued as catalogued
    from pk_jax.mechanisms.explicit import ExplicitMechanism as ExplicitMechanism
    from pk_jax.mechanisms.five_bar import FiveBar as FiveBar
    from pk_jax.mechanisms.planar_rpr import PlanarRPR as PlanarRPR
    from pk_jax.mechanisms.planar_rrr import PlanarRRR as PlanarRRR
    from pk_jax.mechanisms.six_link import SixLink as SixLink
    from pk_jax.mechanisms.stewart import Stewart as Stewart
    from pk_jax.mechanisms.two_rpr import TwoRPR as TwoRPR
    from pk_jax.precision import enable_x64 as enable_x64
    from pk_jax.status import Status as Status
    from pk_jax.viz.skeleton import draw as draw

_NAMES = {
    "pk_jax.analysis.integral": (
        "IntegralGradient",
        "WorkspaceIntegral",
        "integral_gradient",
        "workspace_integral",
    ),
    "pk_jax.design.evaluate": (
        "DesignValues",
        "evaluate_designs",
    ),
    "pk_jax.design.families": (
        "Family",
        "design_family",
    ),
    "pk_jax.design.objectives": (
        "least_over",
        "margins_over",
        "over_workspace",
        "rectangle",
    ),
    "pk_jax.design.optimum": ("OptimizedDesign",),
    "pk_jax.design.pareto": (
        "ParetoDesigns",
        "ParetoFront",
        "pareto_designs",
        "pareto_front",
        "pareto_problem",
    ),
    "pk_jax.design.problem": ("DesignProblem",),
    "pk_jax.design.robust": ("robust",),
    "pk_jax.analysis.boxes": ("Certificate",),
    "pk_jax.analysis.certificate": (
        "certify_confined",
        "certify_regular",
    ),
    "pk_jax.analysis.indices": (
        "LocalIndices",
        "local_indices",
    ),
    "pk_jax.analysis.loci": (
        "LocusCurve",
        "SingularityLocus",
        "singularity_locus",
    ),
    "pk_jax.analysis.redundancy": (
        "Redundancy",
        "resolve_redundancy",
    ),
    "pk_jax.analysis.sensors": (
        "NoiseGain",
        "NoiseGains",
        "SensorLayout",
        "noise_gains",
        "pose_covariance",
        "sensor_layout",
    ),
    "pk_jax.analysis.singularity": (
        "Singularity",
        "SingularityKind",
        "classify_singularity",
        "singularity_distance",
    ),
    "pk_jax.analysis.workspace": (
        "IndexErrors",
        "WorkspaceIndices",
        "workspace_indices",
    ),
    "pk_jax.analysis.workspace_map": (
        "Travel",
        "WorkspaceMap",
        "travel",
        "workspace_map",
    ),
    "pk_jax.control.loop": (
        "Simulation",
        "simulate_control",
    ),
    "pk_jax.control.plant": (
        "Gains",
        "Plant",
    ),
    "pk_jax.control.reference": (
        "Reference",
        "circle_reference",
        "step_reference",
    ),
    "pk_jax.design.calibration": (
        "Calibration",
        "calibrate",
        "stewart_from_log",
    ),
    "pk_jax.design.objective": (
        "IndexBounds",
        "composite_index",
    ),
    "pk_jax.design.optimize": (
        "DesignResult",
        "index_bounds",
        "optimize_design",
    ),
    "pk_jax.design.sensor_placement": (
        "SensorPlacement",
        "place_sensors",
    ),
    "pk_jax.design.variables": (
        "DesignSpace",
        "design_space",
    ),
    "pk_jax.files.mechanism_file": (
        "load_mechanism",
        "save_mechanism",
    ),
    "pk_jax.geometry.axis_pose": ("AxisPose",),
    "pk_jax.geometry.se3": ("SE3",),
    "pk_jax.kinematics.certify": (
        "Certified",
        "certify",
    ),
    "pk_jax.kinematics.modes.assembly": (
        "AssemblyModes",
        "Fate",
        "assembly_modes",
    ),
    "pk_jax.kinematics.forward": (
        "CertifiedKinematics",
        "ForwardKinematics",
        "forward_kinematics",
    ),
    "pk_jax.kinematics.inverse": (
        "InverseKinematics",
        "inverse_kinematics",
        "working_modes",
    ),
    "pk_jax.kinematics.jacobian": (
        "joint_jacobian",
        "pose_jacobian",
        "self_motions",
        "velocity_jacobian",
    ),
    "pk_jax.kinematics.laws": ("check_mechanism",),
    "pk_jax.kinematics.nine_lengths": (
        "NineLengthCandidates",
        "NineLengthPose",
        "nine_length_candidates",
        "nine_length_pose",
    ),
    "pk_jax.kinematics.modes.roadmap": (
        "Connections",
        "Link",
        "connect_modes",
    ),
    "pk_jax.kinematics.statics": (
        "BoundedForces",
        "Screws",
        "bounded_joint_forces",
        "joint_forces",
        "platform_wrench",
        "preloads",
        "screws",
        "stiffness",
    ),
    "pk_jax.kinematics.track": (
        "Track",
        "track",
    ),
    "pk_jax.mechanisms.base": (
        "LegMechanism",
        "Mechanism",
        "Skeleton",
    ),
    "pk_jax.mechanisms.casing_oscillator": ("CasingOscillator",),
    "pk_jax.mechanisms.catalogue": ("catalogued",),
    "pk_jax.mechanisms.explicit": ("ExplicitMechanism",),
    "pk_jax.mechanisms.five_bar": ("FiveBar",),
    "pk_jax.mechanisms.planar_rpr": ("PlanarRPR",),
    "pk_jax.mechanisms.planar_rrr": ("PlanarRRR",),
    "pk_jax.mechanisms.six_link": ("SixLink",),
    "pk_jax.mechanisms.stewart": ("Stewart",),
    "pk_jax.mechanisms.two_rpr": ("TwoRPR",),
    "pk_jax.precision": ("enable_x64",),
    "pk_jax.status": ("Status",),
    "pk_jax.viz.skeleton": ("draw",),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'pk_jax' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
