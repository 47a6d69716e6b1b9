"""Readers of mesh formats: our own for OFF, whose published files violate the format, and trimesh for all others."""

from __future__ import annotations

import io

import numpy as np
import trimesh

from data_pipeline.errors import DamagedMesh

MESH_SUFFIXES = (".off", ".obj", ".stl", ".ply", ".glb")


def parse_mesh(content: bytes, suffix: str, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and triangles (m, 3) of a mesh file.

    Args:
        content: content of the file.
        suffix: format, one of `MESH_SUFFIXES`.
        where: name of the file for error messages.

    Raises:
        DamagedMesh: if the file is not a mesh or is truncated.
    """
    if suffix == ".off":
        return parse_off(content, where)
    try:
        mesh = trimesh.load_mesh(io.BytesIO(content), file_type=suffix[1:], process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # the parsers of trimesh raise exceptions of many kinds
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DamagedMesh(f"{where} is not a readable {suffix} mesh ({reason}); repair it or take it away") from error
    if len(vertices) == 0:
        raise DamagedMesh(
            f"{where} is not a readable {suffix} mesh (nothing was found in it); repair it or take it away"
        )
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def parse_off(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and triangles (m, 3) of an OFF file.

    Also reads what ModelNet's files contain: counts on the first line (`OFF490 518 0`), comments, polygons (split into fans of
    triangles), and colours after the corners of a face.

    Raises:
        DamagedMesh: if the file is not an OFF mesh or is truncated.
    """
    try:
        text = content.decode("ascii")
    except UnicodeDecodeError as error:
        raise DamagedMesh(
            f"{where} is not an OFF mesh: it holds bytes that are not text; repair it or take it away"
        ) from error
    lines = [line.split("#", 1)[0].split() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if not lines or lines[0][0][:3].upper() != "OFF":
        raise DamagedMesh(f"{where} is not an OFF mesh: it does not begin with 'OFF'; repair it or take it away")
    lines[0] = ([lines[0][0][3:]] if lines[0][0][3:] else []) + lines[0][1:]
    counts = [word for line in lines[:2] for word in line][:3]
    try:
        vertex_count, face_count = int(counts[0]), int(counts[1])
        if vertex_count < 0 or face_count < 0 or len(counts) < 3:
            raise ValueError
    except (IndexError, ValueError) as error:
        raise DamagedMesh(f"{where} is not an OFF mesh: its counts are missing; repair it or take it away") from error
    body = lines[1 if lines[0] else 2 :]
    vertex_lines, face_lines = body[:vertex_count], body[vertex_count : vertex_count + face_count]
    whole = [line for line in vertex_lines if len(line) >= 3]
    if len(whole) < vertex_count:
        raise DamagedMesh(
            f"{where} is cut short: {len(whole)} of {vertex_count} vertices are there; fetch or export it again"
        )
    try:
        vertices = np.array([line[:3] for line in vertex_lines], np.float64).reshape(-1, 3)
        triangles: list[tuple[int, int, int]] = []
        for number, line in enumerate(face_lines):  # colours may follow the corners of a face
            corners = int(line[0])
            if len(line) < corners + 1:
                face_lines = face_lines[:number]
                break
            face = [int(word) for word in line[1 : corners + 1]]
            triangles += [(face[0], face[i], face[i + 1]) for i in range(1, corners - 1)]
    except ValueError as error:
        raise DamagedMesh(f"{where} is not an OFF mesh: {error}; repair it or take it away") from error
    if len(face_lines) < face_count:
        raise DamagedMesh(
            f"{where} is cut short: {len(face_lines)} of {face_count} faces are there; fetch or export it again"
        )
    return vertices, np.array(triangles, np.int64).reshape(-1, 3)
