"""One detection result through `rigscape evaluate --detections` and through nuscenes-devkit; both numbers side by side.

    python tests/peers/detection_peers.py RIGSCAPE DATASET VERSION SPLIT

A result file is made from the annotations: boxes are moved, turned, dropped, doubled and scored at random.
"""

import json
import os
import subprocess
import sys
import tempfile

import numpy as np
from nuscenes import NuScenes
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.common.loaders import load_gt
from nuscenes.eval.detection.data_classes import DetectionBox
from nuscenes.eval.detection.evaluate import DetectionEval
from pyquaternion import Quaternion

ERRORS = ["trans_err", "scale_err", "orient_err", "vel_err", "attr_err"]


def made_results(nusc, split, path):
    rng = np.random.default_rng(3)
    truth = load_gt(nusc, split, DetectionBox)
    results = {}
    for token in truth.sample_tokens:
        rows = []
        for box in truth[token]:
            for _ in range(rng.integers(0, 3)):
                turn = Quaternion(box.rotation) * Quaternion(axis=[0, 0, 1], angle=rng.normal(0, 0.4))
                velocity = np.nan_to_num(np.asarray(box.velocity)) + rng.normal(0, 0.5, 2)
                rows.append({
                    "sample_token": token,
                    "translation": [float(x) for x in np.asarray(box.translation) + rng.normal(0, 0.7, 3) * [1, 1, 0.1]],
                    "size": [float(x) for x in np.asarray(box.size) * rng.uniform(0.8, 1.25, 3)],
                    "rotation": [float(x) for x in turn.elements],
                    "velocity": [float(x) for x in velocity],
                    "detection_name": box.detection_name,
                    # Few digits, so that many scores are equal.
                    "detection_score": round(float(rng.uniform()), 2),
                    "attribute_name": box.attribute_name,
                })
        results[token] = rows
    meta = {f"use_{name}": name == "camera" for name in ("camera", "lidar", "radar", "map", "external")}
    with open(path, "w") as file:
        json.dump({"meta": meta, "results": results}, file)


def main():
    program, root, version, split = sys.argv[1:5]
    nusc = NuScenes(version, root, verbose=False)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "results.json")
        made_results(nusc, split, path)
        command = [program, "evaluate", "--detections", path, "--nuscenes", root, "--version", version, "--split", split]
        subprocess.run([*command, "--out", folder], check=True, stdout=subprocess.DEVNULL)
        with open(os.path.join(folder, "detections.json")) as file:
            ours = json.load(file)["score"]
        evaluation = DetectionEval(nusc, config_factory("detection_cvpr_2019"), path, split, folder, verbose=False)
        peer = evaluation.evaluate()[0].serialize()
    print(f"{len(evaluation.sample_tokens)} samples, {sum(map(len, evaluation.gt_boxes.boxes.values()))} true boxes and "
          f"{sum(map(len, evaluation.pred_boxes.boxes.values()))} predictions evaluated; ours {ours['boxes_evaluated']}")
    print(f"{'':<36} {'rigscape':>18} {'devkit':>18} {'apart':>9}")
    rows = [("NDS", ours["nds"], peer["nd_score"]), ("mAP", ours["mean_average_precision"], peer["mean_ap"])]
    rows += [(f"mean {name}", ours["errors"][at], peer["tp_errors"][name]) for at, name in enumerate(ERRORS)]
    for one in ours["classes"]:
        name = one["class"]
        rows.append((f"AP {name}", float(np.mean(one["average_precision"])), peer["mean_dist_aps"][name]))
        for at, error in enumerate(ERRORS):
            if one["errors"][at] is not None:
                rows.append((f"{error} {name}", one["errors"][at], peer["label_tp_errors"][name][error]))
    for what, mine, theirs in rows:
        print(f"{what:<36} {mine:>18.12f} {theirs:>18.12f} {abs(mine - theirs):>9.1e}")
    # The devkit subtracts time stamps in seconds as doubles, which rounds them to 0.2 us; the program subtracts integers.
    timed = [abs(mine - theirs) for what, mine, theirs in rows if "vel_err" in what or what == "NDS"]
    exact = [abs(mine - theirs) for what, mine, theirs in rows if not ("vel_err" in what or what == "NDS")]
    print(f"largest difference {max(exact):.1e} of {len(exact)} numbers; {max(timed):.1e} of {len(timed)} that depend on velocities")
    if not (max(exact) < 1e-9 and max(timed) < 1e-5):
        sys.exit("the numbers differ")


if __name__ == "__main__":
    main()
