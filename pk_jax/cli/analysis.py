"""Singularities, workspaces and proofs: singularity, map, certify, workspace."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from pk_jax.cli import NUMERICAL, begin
from pk_jax.cli.options import FREE, Command, image_kind, takes_mechanism, takes_slice


def add_singularity(command: Command) -> None:
    sub = command("singularity", _singularity, "where a mechanism is singular, and how far from it a pose is")
    takes_mechanism(sub)
    sub.add_argument("--pose", metavar="X,Y,...", help="classify this pose instead of seeking the loci")
    sub.add_argument("--tol", type=float, default=1e-6, help="sigma below this is singular (default: 1e-6)")
    sub.add_argument("--json", action="store_true", help="with --pose: machine-readable")
    takes_slice(
        sub,
        "coordinates of the map, of x, y, z, rx, ry, rz, phi; s, roll, pitch, yaw (default: first two)",
    )
    sub.add_argument("--free", metavar="VALUE", help=f"{FREE}; for loci a value")
    sub.add_argument(
        "--mode", metavar="+-+", help="one working mode (default: all; with --pose: the mechanism's own)"
    )
    sub.add_argument("--kind", action="append", choices=("I", "II"), help="only this type (default: both)")
    sub.add_argument(
        "--nodes", type=int, help="of the grid, along each axis (default: 101; 25 for three axes)"
    )
    sub.add_argument("-o", "--out", metavar="FILE", help="the map with its loci, a .png, .svg or .pdf")
    sub.add_argument("--csv", metavar="FILE", help="every point of the loci")


def _singularity(options: argparse.Namespace) -> int:
    kind = image_kind(options.out) if options.out else None
    progress = begin()
    from pk_jax.files import singular
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.options import signs_of
    from pk_jax.files.shown import as_json, configuration_at
    from pk_jax.files.stream import pose_of
    from pk_jax.viz import singularity as viz

    named = named_mechanism(options.mechanism, options.unit)
    with contextlib.ExitStack() as stack:
        image = stack.enter_context(output_file(options.out)) if options.out else None
        if options.pose is not None:
            signs = signs_of(options.mode)
            pose, joints, _ = configuration_at(named, options.pose, signs, options.free)
            found = singular.classified(named, pose, joints, options.tol)
            print(as_json(found) if options.json else singular.classified_text(found))
            if image:
                axes = viz.draw_screws(named.mechanism, pose, joints)
                axes.set_title(f"{Path(named.name).name}: {found['kind']}")
                axes.figure.savefig(image, format=kind, dpi=150)
            return 0
        table = stack.enter_context(output_file(options.csv)) if options.csv else None
        at = None if options.at is None else pose_of(named, options.at, "--at")
        locus = singular.locus_of(
            named,
            options.axes,
            at,
            options.range,
            options.mode,
            options.kind or ("I", "II"),
            options.nodes,
            progress,
            options.free,
        )
        progress.close()
        if table:
            table.write(singular.locus_rows(named, locus).encode())
        if image:
            unit = named.unit if (named.path or options.unit) and named.unit != "1" else ""
            figure = viz.draw_locus(named.mechanism, locus, unit=unit, scale=named.metres)
            figure.savefig(image, format=kind, dpi=150)
        print(singular.locus_text(named, locus))
    return 0


def add_map(command: Command) -> None:
    sub = command("map", _map, "the workspace within the limits of all joints: smallest margin, and travels")
    takes_mechanism(sub)
    takes_slice(sub, "coordinates of the map (default: the first two)")
    sub.add_argument("--mode", metavar="+-+", help="working mode (default: the mechanism's own)")
    sub.add_argument(
        "--free", metavar="VALUE", help="kinematically redundant joints, or any (default: home's)"
    )
    sub.add_argument("--nodes", type=int, help="of the grid, along each axis (default: 201)")
    sub.add_argument("-o", "--out", metavar="FILE", help="the map, a .png, .svg or .pdf")
    sub.add_argument("--csv", metavar="FILE", help="every node of the map")


def _map(options: argparse.Namespace) -> int:
    kind = image_kind(options.out) if options.out else None
    begin()
    from pk_jax.files import limits
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.stream import pose_of
    from pk_jax.viz.workspace_map import draw_map

    named = named_mechanism(options.mechanism, options.unit)
    with contextlib.ExitStack() as stack:
        image = stack.enter_context(output_file(options.out)) if options.out else None
        table = stack.enter_context(output_file(options.csv)) if options.csv else None
        at = None if options.at is None else pose_of(named, options.at, "--at")
        found, travels = limits.map_of(
            named, options.axes, at, options.range, options.mode, options.free, options.nodes
        )
        if table:
            table.write(limits.map_rows(named, found).encode())
        if image:
            unit = "" if named.unit == "1" else named.unit
            axes = draw_map(found, unit=unit, scale=named.metres)
            axes.set_title(Path(named.name).name)
            axes.figure.savefig(image, format=kind, dpi=150)
        print(limits.map_text(named, found, travels))
    return 0


def add_certify(command: Command) -> None:
    sub = command(
        "certify",
        _certify,
        "prove that a box of poses has no singularity, and that limits don't let it be left",
    )
    takes_mechanism(sub)
    sub.add_argument(
        "--range", action="append", default=[], metavar="A=LO:HI", help="of a coordinate or free joint; rad"
    )
    sub.add_argument("--at-least", type=float, default=0.0, help="what |det A| over that at home must exceed")
    sub.add_argument("--within", metavar="A,B", help="margins that limit the poses (default: all)")
    sub.add_argument(
        "--most", type=int, default=1_000_000, metavar="N", help="boxes to examine (default: %(default)s)"
    )


def _certify(options: argparse.Namespace) -> int:
    progress = begin()
    from pk_jax.files import limits
    from pk_jax.files.named import named_mechanism

    named = named_mechanism(options.mechanism, options.unit)
    found = limits.certificates_of(
        named, options.range, options.at_least, options.within, options.most, progress
    )
    progress.close()
    print(limits.certificates_text(named, found, options.at_least))
    return 0 if all(each.is_proved for each in found.values()) else NUMERICAL


def add_workspace(command: Command) -> None:
    sub = command(
        "workspace",
        _workspace,
        "integrals over the workspace: GII, GRI, SUI of a 2-RPR or 2-RRR, any index of any",
    )
    sub.add_argument("mechanism", help="2-rpr, 2-rrr, a catalogue entry (see: pk-jax list) or a TOML file")
    sub.add_argument("--half-base", type=float, default=1.0, help="R (default: 1)")
    sub.add_argument("--l-min", type=float, help="least distance from a base joint to the end point")
    sub.add_argument("--l-max", type=float, help="greatest distance (default: l_min + 2 R, eq. 20)")
    sub.add_argument("--proximal", type=float, help="driven link of the 2-rrr (default: R)")
    sub.add_argument(
        "--rule",
        help="gauss, midpoint or paper (default: gauss); with --index strokes, panels or rays",
    )
    sub.add_argument("--nodes", type=int, nargs=2, metavar=("OUTER", "INNER"), help="nodes of the rule")
    sub.add_argument(
        "--index",
        action="append",
        metavar="NAME",
        help="volume, integral and mean of a local index, of any mechanism with limits: frobenius_isotropy, "
        "isotropy, resistivity, manipulability, stiffness, clearance, singularity_distance; again for more",
    )
    sub.add_argument(
        "--range",
        action="append",
        default=[],
        metavar="NAME=LOWER:UPPER",
        help="with --index: limits of a coordinate, rad or the mechanism's unit; may be given again",
    )
    sub.add_argument("--axes", metavar="NAME,...", help="with --index: coordinates that vary (default: all)")
    sub.add_argument("--clearance", type=float, help="with --index: least clearance of singularities")
    sub.add_argument("--rays", type=int, help="with --index: directions in each set, or angles")


def _workspace(options: argparse.Namespace) -> int:
    if options.index is None:
        for name in ("axes", "clearance", "rays"):
            if getattr(options, name) is not None:
                raise ValueError(f"--{name} is for --index")
        if options.range:
            raise ValueError("--range is for --index")
        return _paper_indices(options)
    if options.nodes is not None:
        raise ValueError("--nodes is for GII, GRI and SUI; with --index say --rays")
    progress = begin()
    import pk_jax as pk
    from pk_jax.files import limits
    from pk_jax.files.named import Named, named_mechanism

    if options.mechanism in ("2-rpr", "2-rrr"):
        named = Named(_mechanism(options), options.mechanism, "1", 1.0, None)
    else:
        _mechanism(options)  # which takes no lengths
        named = named_mechanism(options.mechanism)
    progress.say("integrating")
    found = limits.integral_of(
        named, options.index, options.range, options.axes, options.clearance, options.rule, options.rays
    )
    progress.close()
    print(limits.integral_text(named, options.index, found))
    return 0 if int(found.status) == pk.Status.OK else NUMERICAL


def _paper_indices(options: argparse.Namespace) -> int:
    begin()
    import pk_jax as pk

    mech = _mechanism(options)
    nodes = None if options.nodes is None else tuple(options.nodes)
    rule = options.rule or "gauss"
    found = pk.workspace_indices(mech, rule, nodes)
    print(f"{mech!r}\nrule {rule}")
    for name in ("gii", "gri", "sui", "area"):
        error = float(getattr(found.error, name))
        estimate = f"  +- {error:.1e}" if error == error else ""
        print(f"{name:5}{float(getattr(found, name)):.12g}{estimate}")
    return 0


def _mechanism(options: argparse.Namespace):
    """The 2-RPR or 2-RRR that the options describe, eqs. (20) and (22) filled in."""
    import pk_jax as pk
    from pk_jax.files.named import named_mechanism

    if options.mechanism in ("2-rpr", "2-rrr"):
        if options.l_min is None:
            raise ValueError(f"--l-min is needed for {options.mechanism}")
        r, l_min = options.half_base, options.l_min
        l_max = l_min + 2 * r if options.l_max is None else options.l_max
        if options.mechanism == "2-rpr":
            if options.proximal is not None:
                raise ValueError("--proximal is for 2-rrr only")
            return pk.TwoRPR(half_base=r, l_min=l_min, l_max=l_max)
        proximal = r if options.proximal is None else options.proximal
        return pk.FiveBar(half_base=r, proximal=proximal, distal=l_max - proximal, reach=(l_min, l_max))
    if options.l_min is not None or options.l_max is not None or options.proximal is not None:
        raise ValueError(f"{options.mechanism} has its own lengths and takes no others")
    return named_mechanism(options.mechanism).mechanism
