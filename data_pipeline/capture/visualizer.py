"""Capture by the thesis's method (§4.1): Open3D's `Visualizer`, a window rendered with OpenGL.

It needs a display (on a server, `xvfb-run -a mevs data --dataset.capture.backend visualizer`) and about a quarter of a second
per view with software rendering. Ray casting (`data_pipeline.capture.casting`) gives the same views; this module exists for
comparison. Unlike the thesis's script, it moves the camera instead of the mesh, and sets the camera's distance instead of
deriving it from the bounding box, so no view depends on the previous one.
"""

from __future__ import annotations

import math

import numpy as np

from data_pipeline.capture.casting import Capture, Rig, store_depth
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import Mesh
from data_pipeline.objects.open3d_parts import load_open3d
from data_pipeline.objects.reconstruction import surface_of


def capture_with_visualizer(mesh: Mesh, rig: Rig) -> Capture:
    """Returns depth and shaded image of `mesh` from every camera of `rig`, rendered by Open3D.

    Raises:
        DataError: if Open3D cannot be loaded, there is no display, or Open3D rejects the resolution.
    """
    try:
        open3d = load_open3d()
    except (ImportError, OSError) as error:
        reason = f"which cannot be loaded here ({error})"
        way_out = "use --dataset.capture.backend raycast"
        raise DataError(f"the visualizer backend needs Open3D, {reason}; {way_out}") from error

    views, side = rig.directions.shape[:2]
    focal = side / 2 / math.tan(rig.field_of_view / 2)
    visualizer = open3d.visualization.Visualizer()
    if not visualizer.create_window(width=side, height=side, visible=False):
        way_out = "run it under xvfb-run -a, or use --dataset.capture.backend raycast"
        raise DataError(f"the visualizer backend needs a display; {way_out}")
    try:
        surface = surface_of(mesh)
        surface.compute_triangle_normals()
        visualizer.add_geometry(surface)
        options = visualizer.get_render_option()
        options.background_color = np.zeros(3)
        options.mesh_show_back_face = True  # the faces of CAD models are not oriented consistently
        control = visualizer.get_view_control()
        depth, image = np.zeros((views, side, side), np.float32), np.zeros((views, side, side), np.uint8)
        for view in range(views):
            camera = open3d.camera.PinholeCameraParameters()
            # Open3D accepts only this principal point, half a pixel off; its images are centred all the same.
            middle = side / 2 - 0.5
            camera.intrinsic = open3d.camera.PinholeCameraIntrinsic(side, side, focal, focal, middle, middle)
            camera.extrinsic = np.linalg.inv(rig.poses[view].astype(np.float64))
            if not control.convert_from_pinhole_camera_parameters(camera, allow_arbitrary=True):
                raise DataError(f"Open3D's window rejected a camera of {side}×{side} pixels; use another resolution")
            distance = float(np.linalg.norm(rig.poses[view, :3, 3]))
            control.set_constant_z_near(max(distance - 1.01, 0.01))
            control.set_constant_z_far(distance + 1.01)
            visualizer.poll_events()
            visualizer.update_renderer()
            depth[view] = np.asarray(visualizer.capture_depth_float_buffer(do_render=True))
            shaded = np.asarray(visualizer.capture_screen_float_buffer(do_render=True)).mean(axis=-1)
            image[view] = np.where(depth[view] > 0, np.round(255 * shaded), 0)
    finally:
        visualizer.destroy_window()
    return Capture(store_depth(np.where(depth > 0, depth, np.inf)), image, mesh.extent, mesh.radius)
