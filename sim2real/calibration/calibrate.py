"""`dlo robot calibrate`: samples of a board in each gripper, and what they tell of the cell."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from dlo_gym.exceptions import DloError
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.geometry.se3 import Array
from dlo_gym.output_folder import check_output_folder
from dlo_gym.scene.arms import SIDES
from sim2real.calibration.board import BoardSpec, Detection
from sim2real.calibration.cell_file import changes
from sim2real.calibration.collect import collect as collect_planned
from sim2real.calibration.collect import collect_by_hand, visited
from sim2real.calibration.intrinsics import Intrinsics, calibrate_intrinsics
from sim2real.calibration.plan import PlannedPose, check_tour, load_plan, plan_poses, save_plan
from sim2real.calibration.report import MADE, result_table, write_report
from sim2real.calibration.samples import Sample, SampleFolder, SamplesError
from sim2real.calibration.solve import CellCalibration, calibrate_cell
from sim2real.config import CellConfig, update_cell_file


class CalibrationRefused(DloError):
    """A calibration is too bad to be saved, or to be used."""


def calibrate(
    cell: Path,
    /,
    *,
    samples: Path = Path("calibration"),
    collect: Literal["none", "left", "right"] = "none",
    by_hand: bool = False,
    poses: int = 25,
    joint_speed: float = 0.3,
    board: BoardSpec = BoardSpec(),  # noqa: B008 - frozen
    intrinsics: Literal["refine", "estimate", "keep"] = "refine",
    out: Path = Path("out/calibration"),
    overwrite: bool = False,
    write: bool = True,
    force: bool = False,
    seed: int = 0,
) -> None:
    """Calibrate all cameras of a cell, and the right arm's base against the left one's.

    First collect samples, once per arm with the board in its gripper (`--collect left`, then
    `--collect right`); then run without `--collect`: cameras' intrinsics and poses and the right
    base go into the cell file, with residuals, verdict, date and hash. A bad calibration is not
    saved.

    Args:
        cell: cell file; its camera and base poses need only be rough.
        samples: folder of samples, made and added to by --collect.
        collect: arm that carries the board; it MOVES through collision-checked poses. Repeating the
            command goes on where it was cut off.
        by_hand: collect without moving the arm: a sample whenever somebody has guided it to a new
            pose and it has stood still for a second.
        poses: to collect.
        joint_speed: of the arm while collecting [rad/s].
        board: that is carried, as measured on the print.
        intrinsics: refine them together with the poses, estimate them beforehand from the images
            alone, or keep those of the cell file.
        out: folder for the report.
        overwrite: replace a former report.
        write: save the result into the cell file.
        force: save it even if it is bad.
        seed: of planning and outlier votes.
    """
    config = CellConfig.load(cell)
    console = Console()
    if poses < 5:
        raise ValueError(f"poses: expected at least 5, got {poses}")
    if not 0.0 < joint_speed <= 1.0:
        raise ValueError(f"joint_speed: expected 0 < speed <= 1 rad/s, got {joint_speed}")
    if collect != "none":
        added = _collect(
            config, samples, collect, board, poses, joint_speed, seed, console, by_hand=by_hand
        )
        console.print(f"{added} samples of the {collect} arm added to {samples}", soft_wrap=True)
        return
    check_output_folder(out, MADE, overwrite=overwrite)
    folder = SampleFolder.open(samples)
    with console.status("finding the board in the images"):
        taken, by_hand_views = load_samples(config, folder)
    with console.status("calibrating"):
        lenses, start = starting_cameras(
            config, folder.board, taken, by_hand_views, estimate=intrinsics != "keep"
        )
        found = calibrate_cell(
            folder.board,
            taken,
            start,
            {side: config.arms[side].T_world_base for side in config.arms},
            np.random.default_rng(seed),
            refine_intrinsics=intrinsics == "refine",
            lens_views=by_hand_views,
        )
    write_report(out, config.name, folder.board, taken, found, lenses)
    console.print(result_table(found))
    for reason in _notes(found, lenses):
        console.print(f"- {reason}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"report: {out / 'report.html'}", highlight=False, markup=False, soft_wrap=True)
    if found.verdict == "bad" and not force:
        raise CalibrationRefused(
            "the calibration is bad and was not saved; the report shows why (--force saves it)"
        )
    if write:
        update_cell_file(cell, changes(config, found, folder.digest()))
        console.print(f"saved: {cell}", highlight=False, markup=False, soft_wrap=True)


def load_samples(
    config: CellConfig, folder: SampleFolder
) -> tuple[list[Sample], dict[str, list[Detection]]]:
    """All samples of a folder, and per camera the views of a board held by hand.

    Raises:
        SamplesError: if a camera of the cell has no images there, or of another size.
    """
    for name, camera in config.cameras.items():
        size = folder.image_sizes.get(name)
        if size != (camera.width_px, camera.height_px):
            raise SamplesError(
                f"{folder.path}: expected {camera.width_px}x{camera.height_px} images of camera"
                f" {name!r}, got {'none' if size is None else f'{size[0]}x{size[1]}'}"
            )
    if not folder.entries:
        raise SamplesError(f"{folder.path}: holds no samples; --collect left, then --collect right")
    cameras = list(config.cameras)
    return folder.samples(cameras), {name: folder.extra_views(name) for name in cameras}


def starting_cameras(
    config: CellConfig,
    board: BoardSpec,
    samples: Sequence[Sample],
    by_hand: Mapping[str, Sequence[Detection]],
    *,
    estimate: bool,
) -> tuple[dict[str, Intrinsics], dict[str, CameraModel]]:
    """Intrinsics of every camera from all its views, if asked for, and the cameras with them.

    Raises:
        ValueError: naming the camera whose views are too few.
    """
    lenses: dict[str, Intrinsics] = {}
    cameras: dict[str, CameraModel] = {}
    for model in config.camera_models:
        cameras[model.name] = model
        if not estimate:
            continue
        views = [sample.detections.get(model.name, Detection.nothing()) for sample in samples]
        try:
            lens = calibrate_intrinsics(
                board, [*views, *by_hand.get(model.name, [])], (model.width, model.height)
            )
        except ValueError as error:
            raise ValueError(f"camera {model.name!r}: {error}") from error
        lenses[model.name] = lens
        cameras[model.name] = replace(model, K=lens.K, distortion=lens.distortion)
    return lenses, cameras


def _notes(found: CellCalibration, lenses: Mapping[str, Intrinsics]) -> list[str]:
    about_lenses = [
        f"camera {name!r}: {warning}" for name, lens in lenses.items() for warning in lens.warnings
    ]
    return [*found.reasons, *about_lenses]


def _collect(
    config: CellConfig,
    path: Path,
    side: Literal["left", "right"],
    board: BoardSpec,
    poses: int,
    joint_speed: float,
    seed: int,
    console: Console,
    *,
    by_hand: bool,
) -> int:
    # Devices are loaded only where they are used: the offline part needs no ur_rtde.
    from sim2real.cell import make_arm, make_cameras

    sizes = {model.name: (model.width, model.height) for model in config.camera_models}
    folder = SampleFolder.create(path, board, sizes)
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), console=console
    )
    with ExitStack() as stack:
        cameras = {
            name: stack.enter_context(camera) for name, camera in make_cameras(config).items()
        }
        arms = {}
        for name in SIDES if not by_hand else (side,):
            arms[name] = stack.enter_context(make_arm(config, name))
            arms[name].connect(control=name == side and not by_hand)
        plan = []
        if not by_hand:
            joints = {name: arm.reading().joint_angles for name, arm in arms.items()}
            plan = _plan(config, folder, side, poses, seed, joints)
        stack.enter_context(progress)
        task = progress.add_task(f"{side} arm", total=poses if by_hand else len(plan))

        def on_sample(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        if by_hand:
            return collect_by_hand(folder, arms[side], cameras, poses, on_sample=on_sample)
        return collect_planned(
            folder, arms[side], cameras, plan, joint_speed=joint_speed, on_sample=on_sample
        )


def _plan(
    config: CellConfig,
    folder: SampleFolder,
    side: str,
    poses: int,
    seed: int,
    joints: Mapping[str, Array],
) -> list[PlannedPose]:
    """The folder's plan for one arm, made if there is none, with the rest of it checked."""
    other = SIDES[1 - SIDES.index(side)]
    file = folder.path / f"plan_{side}.json"
    if not file.exists():
        plan = plan_poses(
            config.dual_arm,
            config.camera_models,
            side,
            folder.board,
            poses,
            np.random.default_rng([seed, SIDES.index(side)]),
            start=joints[side],
            parked=joints[other],
        )
        save_plan(file, plan)
        return plan
    plan, done = load_plan(file), visited(folder, side)
    left = [stop for k, stop in enumerate(plan) if k not in done]
    check_tour(config.dual_arm, side, folder.board, left, start=joints[side], parked=joints[other])
    return plan
