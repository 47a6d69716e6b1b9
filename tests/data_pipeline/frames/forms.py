"""A recording of three images of a ball on a wall, written in every form that is read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mevs_jax.geometry.cameras import look_at_origin

CENTER, RADIUS = np.array([0.5, 0.1, 0.8]), 0.2
WIDTH, HEIGHT = 80, 60
K = np.array([[90.0, 0, 40.5], [0, 91.0, 28.5], [0, 0, 1]])
OBJECT = 5
TIMES = np.array([100.0, 100.5, 101.0])


def poses() -> np.ndarray:
    """Cameras around the ball, each with another roll."""
    eyes = np.array([[0.8, 0, 0.3], [0.1, 0.9, 0.2], [-0.7, 0.2, 0.5]], np.float32)
    made = np.stack([np.asarray(look_at_origin(eye), float) for eye in eyes])
    turned, _ = np.linalg.qr(made[:, :3, :3])  # orthonormal in float64
    made[:, :3, :3] = turned * np.sign(np.einsum("nij,nij->nj", turned, made[:, :3, :3]))[:, None]
    made[:, :3, 3] += CENTER
    return made


def depth_and_mask() -> tuple[np.ndarray, np.ndarray]:
    """Depth in whole millimetres, of the ball and of a wall 2 m away with a hole; where the ball is."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    depths, masks = [], []
    for pose in poses():
        middle = pose[:3, :3].T @ (CENTER - pose[:3, 3])
        along, square = rays @ middle, (rays**2).sum(axis=-1)
        inside = along**2 - square * (middle @ middle - RADIUS**2)
        ball = (along - np.sqrt(np.maximum(inside, 0))) / square
        depth = np.where(inside > 0, ball, 2.0)
        depth[:4, :4] = 0
        depths.append(np.round(depth, 3)), masks.append(inside > 0)
    return np.stack(depths), np.stack(masks)


def write_png(path: Path, depth: np.ndarray, unit: float, unknown: int = 0) -> None:
    pixels = np.round(depth / unit).astype(np.uint16)
    Image.fromarray(np.where(depth > 0, pixels, np.uint16(unknown)).astype(np.uint16)).save(path)


def npz(folder: Path) -> Path:
    depth, mask = depth_and_mask()
    np.savez(folder / "frames.npz", depth=depth, mask=mask, K=K, T_world_camera=poses(), floor=np.array(0.1))
    return folder / "frames.npz"


def seven_scenes(
    folder: Path, depths: np.ndarray | None = None, at: np.ndarray | None = None, K: np.ndarray = K
) -> Path:
    """The ball, or other images at other poses."""
    folder.mkdir(exist_ok=True)
    depths, at = depth_and_mask()[0] if depths is None else depths, poses() if at is None else at
    for number, (depth, pose) in enumerate(zip(depths, at, strict=True)):
        write_png(folder / f"frame-{number:06d}.depth.png", depth, 0.001, unknown=65535 if number else 0)
        np.savetxt(folder / f"frame-{number:06d}.pose.txt", pose)
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


def tum(folder: Path) -> Path:
    """With a fourth image, which has no pose, and poses in between, which have no image."""
    (folder / "depth").mkdir(parents=True)
    listed = ["# time file"]
    depths = depth_and_mask()[0]
    for time, depth in zip([*TIMES, 200.0], [*depths, depths[0]], strict=True):
        write_png(folder / "depth" / f"{time:.6f}.png", depth, 1 / 5000)
        listed.append(f"{time:.6f} depth/{time:.6f}.png")
    (folder / "depth.txt").write_text("\n".join(listed))
    lines = ["# time tx ty tz qx qy qz qw"]
    for time, pose in zip(TIMES, poses(), strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        for late, shift in ((-0.1, 1.0), (0.011, 0.0), (0.03, 2.0)):
            numbers = [time + late, *(pose[:3, 3] + shift), *quaternion]
            lines.append(" ".join(f"{number:.12f}" for number in numbers))
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    (folder / "calibration.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    return folder


def bop(folder: Path, placed: bool = True) -> Path:
    """The ball is object 5, after or before object 1; its frame is turned and lies at its centre."""
    (folder / "depth").mkdir(parents=True)
    (folder / "mask_visib").mkdir()
    object_pose = np.eye(4)
    object_pose[:3, :3], object_pose[:3, 3] = Rotation.from_euler("z", 0.3).as_matrix(), CENTER
    cameras, truth = {}, {}
    for number, (depth, mask, pose) in enumerate(zip(*depth_and_mask(), poses(), strict=True)):
        write_png(folder / "depth" / f"{number:06d}.png", depth, 0.0001)
        place = (number + 1) % 2
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "mask_visib" / f"{number:06d}_{place:06d}.png")
        cameras[number] = {"cam_K": K.ravel().tolist(), "depth_scale": 0.1}
        if placed:
            cameras[number] |= _entry("w2c", np.linalg.inv(pose))
        seen = _entry("m2c", np.linalg.inv(pose) @ object_pose)
        truth[number] = [{"obj_id": one} | seen for one in ((OBJECT, 1), (1, OBJECT))[place]]
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(truth))
    return folder


def _entry(kind: str, pose: np.ndarray) -> dict:
    return {f"cam_R_{kind}": pose[:3, :3].ravel().tolist(), f"cam_t_{kind}": (1000 * pose[:3, 3]).tolist()}


def clouds(folder: Path, viewpoint: bool = False) -> Path:
    """Organised clouds with NaN where nothing was measured; poses in files of their own, or in the header."""
    folder.mkdir(parents=True)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    for number, (depth, pose) in enumerate(zip(depth_and_mask()[0], poses(), strict=True)):
        points = np.where(depth > 0, depth, np.nan)[..., None] * rays
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        place = " ".join(map(str, [*pose[:3, 3], w, x, y, z] if viewpoint else [0, 0, 0, 1, 0, 0, 0]))
        header = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            f"WIDTH {WIDTH}\nHEIGHT {HEIGHT}\nVIEWPOINT {place}\nPOINTS {WIDTH * HEIGHT}\nDATA binary\n"
        )
        (folder / f"scan{number}.pcd").write_bytes(header.encode() + points.astype("<f4").tobytes())
        if not viewpoint:
            np.savetxt(folder / f"scan{number}.pose.txt", pose)
    return folder
