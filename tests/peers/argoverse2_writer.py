"""Loads a folder in the Argoverse 2 sensor layout with the official package and checks what a user would rely on.

    python argoverse2_writer.py DIR

Prints one line per check and ends non-zero at the first failure. See README.md for how to make the environment.
"""

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
from av2.datasets.sensor.constants import AnnotationCategories, RingCameras
from av2.datasets.sensor.sensor_dataloader import SensorDataloader
from av2.geometry.camera.pinhole_camera import PinholeCamera
from av2.map.map_api import ArgoverseStaticMap
from av2.structures.cuboid import CuboidList
from av2.utils.io import read_city_SE3_ego, read_ego_SE3_sensor, read_feather

RING = {camera.value for camera in RingCameras}
POSE = {name: "double" for name in ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"]}
# Column types of the release.
TYPES = {
    "annotations": {
        "timestamp_ns": "int64",
        "track_uuid": "string",
        "category": "string",
        "length_m": "double",
        "width_m": "double",
        "height_m": "double",
        **POSE,
        "num_interior_pts": "int64",
    },
    "city_SE3_egovehicle": {"timestamp_ns": "int64", **POSE},
    "calibration/egovehicle_SE3_sensor": {"sensor_name": "string", **POSE},
    "calibration/intrinsics": {
        "sensor_name": "string",
        **{name: "double" for name in ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3"]},
        "height_px": "uint16",
        "width_px": "uint16",
    },
}
SWEEP = {
    "x": "halffloat",
    "y": "halffloat",
    "z": "halffloat",
    "intensity": "uint8",
    "laser_number": "uint8",
    "offset_ns": "int32",
}
# Rounding at the faces of boxes, on which points of the procedural world lie.
FACE_SHARE = 0.001
# The ego frame of the procedural world lies on the ground.
GROUND_TOLERANCE_M = 0.05


def require(holds, text):
    if not holds:
        raise SystemExit(f"FAILED: {text}")


def report(what, text):
    print(f"{what:<22}{text}", flush=True)


def check_types(logs):
    files = 0
    for log in logs:
        tables = {log / f"{name}.feather": want for name, want in TYPES.items()}
        tables |= {path: SWEEP for path in sorted((log / "sensors/lidar").glob("*.feather"))}
        for path, want in tables.items():
            schema = pa.ipc.open_file(path).schema
            got = {field.name: str(field.type) for field in schema}
            require(got == want, f"{path}: columns {got}")
            files += 1
    report("feather tables", f"{files} files, columns and types of the release")


def check_poses(logs):
    stamps = 0
    for log in logs:
        city_SE3_ego = read_city_SE3_ego(log)
        stamps += len(city_SE3_ego)
        pictures = sorted(log.glob("sensors/cameras/*/*.jpg"))
        sweeps = sorted(log.glob("sensors/lidar/*.feather"))
        for path in pictures + sweeps:
            require(int(path.stem) in city_SE3_ego, f"{path} has no pose")
        rotations = np.array([pose.rotation for pose in city_SE3_ego.values()])
        require(np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3)), f"{log}: a pose is no rotation")
        mounts = read_ego_SE3_sensor(log)
        require({"up_lidar", "down_lidar"} <= set(mounts), f"{log}: lidar mounts")
    report("poses", f"{stamps} rows; every picture and sweep has its own")


def check_frames(root, logs):
    loader = SensorDataloader(root, with_annotations=True, with_cache=False)
    require(len(loader) == sum(len(list(log.glob("sensors/lidar/*.feather"))) for log in logs), "frames")
    pictures, sizes, categories = Counter(), Counter(), Counter()
    points = found = boxes = projected = 0
    for index in range(len(loader)):
        datum = loader[index]
        images = datum.synchronized_imagery
        require(images is not None and set(images) == RING, f"frame {index}: cameras {images and sorted(images)}")
        for name, image in images.items():
            camera = image.camera_model
            require(image.img.shape[:2] == (camera.height_px, camera.width_px), f"frame {index}: size of {name}")
            pictures[name] += 1
            sizes[f"{camera.width_px}x{camera.height_px}"] += 1
        points += len(datum.sweep)
        cuboids = datum.annotations.cuboids
        boxes += len(cuboids)
        for cuboid in cuboids:
            AnnotationCategories(cuboid.category)
            categories[cuboid.category] += 1
            _, inside = cuboid.compute_interior_points(datum.sweep.xyz)
            found += int(inside.sum())
        projected += check_pixels(datum, images)
    report("frames", f"{len(loader)} with {sum(pictures.values())} pictures: {dict(sizes)}")
    report("boxes", f"{boxes}; {', '.join(f'{n} {c}' for c, n in categories.most_common())}")
    require(boxes == 0 or projected > 0, "no box is in any picture")
    report("projection", f"{projected} box centres in pictures")
    # The package's cuboids carry no counts.
    counted = sum(int(read_feather(log / "annotations.feather")["num_interior_pts"].sum()) for log in logs)
    require(abs(found - counted) <= FACE_SHARE * counted, f"{found} points, {counted} counted")
    report("lidar", f"{points} points; boxes enclose {found}, {counted} counted for them")


def check_pixels(datum, images):
    """Centres of boxes in pictures by the package's own motion-compensated projection."""
    seen = 0
    centres = np.array([cuboid.dst_SE3_object.translation for cuboid in datum.annotations.cuboids]).reshape(-1, 3)
    for image in images.values():
        ego_lidar = datum.timestamp_city_SE3_ego_dict[datum.timestamp_ns]
        ego_camera = datum.timestamp_city_SE3_ego_dict[image.timestamp_ns]
        if len(centres):
            _, _, valid = image.camera_model.project_ego_to_img_motion_compensated(centres, ego_camera, ego_lidar)
            seen += int(valid.sum())
    return seen


def check_calibration(logs):
    """The package's camera model, with the ring's order found from its mounts."""
    for log in logs:
        azimuths = {}
        for name in RING:
            camera = PinholeCamera.from_feather(log, name)
            axis = camera.ego_SE3_cam.rotation[:, 2]
            azimuths[name] = np.degrees(np.arctan2(axis[1], axis[0]))
        front = PinholeCamera.from_feather(log, "ring_front_center")
        require(front.height_px > front.width_px, f"{log}: the front camera is not upright")
        order = sorted(azimuths, key=lambda name: -azimuths[name])
        require(order[3] == "ring_front_center", f"{log}: from left to right {order}")
    report("calibration", f"{len(logs)} rigs of {len(RING)} cameras, front upright")


def check_maps(logs):
    lanes = crossings = areas = drivable = on_road = 0
    heights = []
    for log in logs:
        static_map = ArgoverseStaticMap.from_map_dir(log / "map", build_raster=True)
        lanes += len(static_map.vector_lane_segments)
        crossings += len(static_map.vector_pedestrian_crossings)
        areas += len(static_map.vector_drivable_areas)
        for lane in static_map.get_scenario_lane_segments():
            require(np.isfinite(static_map.get_lane_segment_centerline(lane.id)).all(), f"{log}: lane {lane.id}")
        poses = read_city_SE3_ego(log).values()
        cars = np.array([pose.translation for pose in poses])
        inside = static_map.get_raster_layer_points_boolean(cars, layer_name="DRIVABLE_AREA")
        drivable += len(cars)
        on_road += int(inside.sum())
        heights.extend(cars[:, 2] - static_map.raster_ground_height_layer.get_ground_height_at_xy(cars))
        near = static_map.get_nearby_lane_segments(cars[0, :2], search_radius_m=10.0)
        require(len(near) > 0, f"{log}: no lane at the car")
    require(on_road == drivable, f"{drivable - on_road} of {drivable} poses are off the drivable area")
    heights = np.abs(heights)
    require(heights.max() < GROUND_TOLERANCE_M, f"the car is {heights.max()} m off the ground")
    report("maps", f"{lanes} lanes, {crossings} crossings, {areas} drivable areas")
    report("at the car", f"{drivable} poses on the drivable area, at most {heights.max():.3f} m off the ground")


def check_tracks(logs):
    tracks = moves = 0
    for log in logs:
        table = read_feather(log / "annotations.feather")
        seen = set(zip(table["timestamp_ns"], table["track_uuid"]))
        require(len(seen) == len(table), f"{log}: a track has two boxes at one stamp")
        require(len(CuboidList.from_feather(log / "annotations.feather")) == len(table), f"{log}: boxes are lost")
        tracks += len({track for _, track in seen})
        moves += len({stamp for stamp, _ in seen})
    report("tracks", f"{tracks} over {moves} annotated stamps, each at most once per stamp")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    root = parser.parse_args().root
    logs = sorted(path.parent for path in root.glob("*/*/city_SE3_egovehicle.feather"))
    require(len(logs) > 0, f"no log in {root}")
    splits = Counter(log.parent.name for log in logs)
    report("logs", ", ".join(f"{count} in {split}" for split, count in sorted(splits.items())))
    check_types(logs)
    check_poses(logs)
    check_calibration(logs)
    check_tracks(logs)
    check_frames(root, logs)
    check_maps(logs)
    print("all checks passed")


if __name__ == "__main__":
    main()
