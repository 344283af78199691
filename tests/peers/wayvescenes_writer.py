"""Loads a folder in the WayveScenes101 layout with pycolmap and checks what a user would rely on.

    python wayvescenes_writer.py DIR        (needs: pip install pycolmap pillow)

Prints one line per check and ends non-zero at the first failure. See README.md.
"""

import argparse
import csv
import json
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

REFERENCE = "front-forward"
SHORT = {"ff": REFERENCE, "rf": "right-forward", "rb": "right-backward", "lb": "left-backward", "lf": "left-forward"}
# Features are the projections of their points, written with all digits.
REPROJECTION_PX = 1e-6
# The cameras of a region agree about the scale.
SCALE_SPREAD = 1e-3


def require(holds, text):
    if not holds:
        raise SystemExit(f"FAILED: {text}")


def report(what, text):
    print(f"{what:<22}{text}", flush=True)


def pose_of(image):
    pose = image.cam_from_world
    return pose() if callable(pose) else pose


def centre_of(image):
    return pose_of(image).inverse().translation


def check_pictures(scene, model):
    names = {image.name for image in model.images.values()}
    on_disk = {str(path.relative_to(scene / "images")) for path in (scene / "images").rglob("*") if path.is_file()}
    require(names == on_disk, f"{scene.name}: {len(names ^ on_disk)} pictures are on one side only")
    sizes = Counter()
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        with Image.open(scene / "images" / image.name) as picture:
            require(picture.format == "JPEG", f"{image.name} is {picture.format}")
            picture.load()
            require(picture.size == (camera.width, camera.height), f"{image.name} is {picture.size}")
            sizes[picture.size] += 1
    models = Counter(camera.model.name for camera in model.cameras.values())
    report("  pictures", f"{len(names)}, all decoded: {dict(sizes)}; cameras {dict(models)}")


def check_features(scene, model):
    worst, count = 0.0, 0
    for image in model.images.values():
        camera, pose = model.cameras[image.camera_id], pose_of(image)
        for feature in image.points2D:
            if not feature.has_point3D():
                continue
            point = model.points3D[feature.point3D_id]
            seen = camera.img_from_cam(pose * point.xyz)
            worst = max(worst, float(np.linalg.norm(seen - feature.xy)))
            count += 1
    tracks = sum(point.track.length() for point in model.points3D.values())
    require(count == tracks, f"{scene.name}: {count} features show points, tracks name {tracks}")
    require(count > 0 and worst < REPROJECTION_PX, f"{scene.name}: reprojection is off by {worst} px")
    report("  features", f"{count} of {len(model.points3D)} points; pycolmap projects them {worst:.1e} px off at most")


def check_rewrite(scene, model):
    with tempfile.TemporaryDirectory() as folder:
        model.write_text(folder)
        again = pycolmap.Reconstruction(folder)
    pairs = [(image, again.images[key]) for key, image in model.images.items()]
    off = max(float(np.abs(pose_of(a).matrix() - pose_of(b).matrix()).max()) for a, b in pairs)
    require(len(again.points3D) == len(model.points3D) and off < 1e-9, f"{scene.name}: text form differs by {off}")
    report("  text form", f"written and read by pycolmap, poses differ by {off:.1e}")


def check_scale(scene, model, baselines):
    by_stamp = defaultdict(dict)
    for image in model.images.values():
        channel, stamp = image.name.removesuffix(".jpeg").split("/")
        require(stamp.isdigit(), f"{image.name} has no stamp")
        by_stamp[int(stamp)][channel] = centre_of(image)
    distances = defaultdict(list)
    for centres in by_stamp.values():
        for channel, centre in centres.items():
            if channel != REFERENCE and REFERENCE in centres:
                distances[channel].append(np.linalg.norm(centre - centres[REFERENCE]))
    fits = []
    for region, row in baselines.items():
        metres = {SHORT.get(key[11:-2], key[11:-2]): value for key, value in row.items()}
        scales = [metres[channel] / np.median(values) for channel, values in distances.items() if channel in metres]
        if scales:
            fits.append(((max(scales) - min(scales)) / np.median(scales), float(np.median(scales)), region))
    spread, scale, region = min(fits)
    require(spread < SCALE_SPREAD, f"{scene.name}: the cameras disagree about the scale by {spread}")
    stamps = np.diff(sorted(by_stamp))
    gaps = f"{int(np.median(stamps))} counts apart" if len(stamps) else "one"
    report("  scale", f"{scale:.6f} m per unit, region {region}, spread {spread:.1e}; {len(by_stamp)} stamps, {gaps}")
    return scale


def check_ground(scene, model, scale):
    images = model.images.values()
    up = -np.mean([pose_of(image).inverse().rotation.matrix()[:, 1] for image in images], axis=0)
    points = scale * np.array([point.xyz for point in model.points3D.values()])
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    normal *= np.sign(normal @ up)
    tilt = np.degrees(np.arccos(np.clip(normal @ up / np.linalg.norm(up), -1, 1)))
    fronts = [scale * centre_of(image) for image in images if image.name.startswith(f"{REFERENCE}/")]
    heights = [(centre - points.mean(axis=0)) @ normal for centre in fronts]
    rough = float(np.abs((points - points.mean(axis=0)) @ normal).max())
    require(tilt < 10 and min(heights) > 0.5, f"{scene.name}: ground tilted by {tilt} deg, cameras at {min(heights)} m")
    report("  ground", f"{REFERENCE} {np.median(heights):.3f} m above it; points within {rough:.3f} m; {tilt:.2f} deg from the cameras' up")


def check_masks(scene, model):
    folder = scene / "masks"
    if not folder.is_dir():
        report("  masks", "none")
        return
    masked = {path.name for path in folder.iterdir()}
    shares = []
    for image in model.images.values():
        channel, stamp = image.name.removesuffix(".jpeg").split("/")
        if channel not in masked:
            continue
        camera = model.cameras[image.camera_id]
        path = folder / channel / f"{stamp}.png"
        require(path.is_file(), f"{image.name} has no mask")
        with Image.open(path) as mask:
            values = np.asarray(mask)
            require(mask.mode == "L" and mask.size == (camera.width, camera.height), f"mask of {image.name}: {mask}")
        require(set(np.unique(values)) <= {0, 255}, f"mask of {image.name} holds other values than 0 and 255")
        shares.append(float((values == 0).mean()))
    report("  masks", f"{len(shares)}, 8-bit grey, {min(shares):.3f} to {max(shares):.3f} ignored")


def check_tags(root, scenes):
    with open(root / "scene_metadata.csv", newline="") as file:
        rows = {row["scene_id"]: row for row in csv.DictReader(file)}
    require(sorted(rows) == sorted(scene.name for scene in scenes), f"the table of tags lists {sorted(rows)}")
    filled = sum(1 for row in rows.values() for value in row.values() if value)
    report("tags", f"{len(rows)} rows of {len(next(iter(rows.values())))} columns, {filled} cells filled")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("root", type=Path)
    root = parser.parse_args().root
    baselines = json.loads((root / "baselines.json").read_text())
    scenes = sorted(path.parent.parent for path in root.glob("*/colmap_sparse/rig"))
    require(scenes, f"no scenes in {root}")
    report("pycolmap", pycolmap.__version__)
    for scene in scenes:
        model = pycolmap.Reconstruction(scene / "colmap_sparse/rig")
        report(scene.name, f"{model.num_cameras()} cameras, {model.num_reg_images()} images, {model.num_points3D()} points")
        check_pictures(scene, model)
        check_features(scene, model)
        check_rewrite(scene, model)
        check_ground(scene, model, check_scale(scene, model, baselines))
        check_masks(scene, model)
    check_tags(root, scenes)
    print("all checks passed")


if __name__ == "__main__":
    main()
