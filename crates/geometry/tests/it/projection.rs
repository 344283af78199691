//! Annotated boxes to pixels, with and without compensation of the car's motion, against the official packages' arithmetic.

use geometry::glam::{DMat4, DVec2, DVec3, DVec4};
use geometry::{Box3d, Camera, Intrinsics, Lens, Rigid};

use crate::golden::Golden;

/// Suggested by the golden; the chains run through UTM coordinates of 4e6 m, whose f64 steps are 1e-9 m.
const METRES: f64 = 1e-6;

#[test]
fn boxes_project_like_the_official_packages() {
    let Some(golden) = Golden::open("projection") else { return };
    let cameras = golden.prefixes("wh");
    assert!(!cameras.is_empty());
    let mut views = 0;
    for camera in cameras {
        let (dataset, _) = camera.rsplit_once('/').expect("names are dataset/camera/item");
        for mode in ["compensated", "uncompensated", "view"] {
            if golden.find(&format!("{camera}/{mode}/pixels")).is_some() {
                check_view(&golden, dataset, camera, mode);
                views += 1;
            }
        }
    }
    eprintln!("{views} views");
}

#[test]
fn box_corners_agree_in_every_dataset() {
    let Some(golden) = Golden::open("projection") else { return };
    let mut datasets: Vec<&str> = golden.prefixes("corners_ego");
    datasets.extend(golden.prefixes("corners_world"));
    assert!(!datasets.is_empty());
    for dataset in datasets {
        let ours: Vec<DVec3> = boxes(&golden, dataset).iter().flat_map(|corners| *corners).collect();
        let expected = golden.find_any(dataset, &["corners_ego", "corners_world"]).expect("listed by it").vec3s();
        assert_close(&ours, &expected, METRES, dataset);
    }
}

#[test]
fn pixels_unproject_to_their_rays() {
    let Some(golden) = Golden::open("projection") else { return };
    let cameras = golden.prefixes("grid_pixels");
    assert!(!cameras.is_empty());
    for name in cameras {
        let camera = camera(&golden, name);
        let pixels = golden.get(&format!("{name}/grid_pixels")).vec2s();
        let planes = golden.get(&format!("{name}/grid_normalised")).vec2s();
        for (pixel, plane) in pixels.iter().zip(&planes) {
            let ray = camera.unproject(*pixel).unwrap_or_else(|| panic!("{name}: {pixel} has no ray"));
            let error = (ray.truncate() / ray.z - *plane).length();
            assert!(error < 1e-9 * plane.length().max(1.0), "{name}: {pixel} is off by {error}");
            let back = camera.project(ray * 13.0).unwrap_or_else(|| panic!("{name}: {pixel} does not come back"));
            assert!((back - *pixel).length() < 1e-8, "{name}: {pixel} comes back as {back}");
        }
    }
}

#[test]
fn waymo_axes_become_opencv_axes() {
    let Some(golden) = Golden::open("projection") else { return };
    // Rows: OpenCV's x, y, z from Waymo's x forward, y left, z up.
    let cam_from_waymo = DMat4::from_cols(DVec4::Z, DVec4::NEG_X, DVec4::NEG_Y, DVec4::W);
    for camera in golden.prefixes("extrinsic_file") {
        let vehicle_from_waymo = golden.get(&format!("{camera}/extrinsic_file")).mat4s()[0];
        let ego_from_cam = golden.get(&format!("{camera}/T_ego_cam")).rigids()[0];
        let ours = Rigid::from_mat4(&(vehicle_from_waymo * cam_from_waymo.inverse()));
        assert!(ours.angle_to(&ego_from_cam) < 1e-9, "{camera}");
        assert!(ours.translation.distance(ego_from_cam.translation) < 1e-12, "{camera}");
    }
}

fn assert_close(ours: &[DVec3], expected: &[DVec3], tolerance: f64, what: &str) {
    assert_eq!(ours.len(), expected.len(), "{what}");
    for (i, (a, b)) in ours.iter().zip(expected).enumerate() {
        assert!(a.distance(*b) < tolerance, "{what}, row {i}: {a} instead of {b}");
    }
}

fn camera(golden: &Golden, name: &str) -> Camera {
    let k = golden.get(&format!("{name}/K")).mat3s()[0];
    let size = &golden.get(&format!("{name}/wh")).values;
    let lens = match golden.find(&format!("{name}/dist")).map(|dist| dist.values.as_slice()) {
        None => Lens::Pinhole,
        Some([k1, k2, p1, p2, k3]) => Lens::BrownConrady { k: [*k1, *k2, *k3], p: [*p1, *p2] },
        Some([k1, k2, k3, k4]) => Lens::KannalaBrandt { k: [*k1, *k2, *k3, *k4] },
        Some(other) => panic!("{name}: no lens has coefficients {other:?}"),
    };
    // Raw pixel values as in the files: no half pixel is added here, nor in the expected numbers.
    let intrinsics = Intrinsics {
        fx: k.x_axis.x,
        fy: k.y_axis.y,
        cx: k.z_axis.x,
        cy: k.z_axis.y,
        width: size[0] as u32,
        height: size[1] as u32,
    };
    Camera::new(intrinsics, lens).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// Corners of every box in the dataset's reference frame, each dataset from the numbers its own files hold.
fn boxes(golden: &Golden, dataset: &str) -> Vec<[DVec3; 8]> {
    let find = |names: &[&str]| golden.find_any(dataset, names);
    let sizes: Vec<DVec3> = match find(&["size_wlh"]) {
        Some(size) => size.rows().iter().map(|[w, l, h]| DVec3::new(*l, *w, *h)).collect(),
        None => golden.get(&format!("{dataset}/size_lwh")).vec3s(),
    };
    let centers = find(&["translation_global", "center_global", "t_ego", "center", "center_world"])
        .unwrap_or_else(|| panic!("{dataset} has no centres"))
        .vec3s();
    if let Some(rotations) = find(&["R_world_object"]) {
        let pose = |(matrix, center): (_, &DVec3)| {
            Rigid::from_mat4(&(DMat4::from_translation(*center) * DMat4::from_mat3(matrix)))
        };
        let poses: Vec<Rigid> = rotations.mat3s().into_iter().zip(&centers).map(pose).collect();
        let corners = |(pose, size): (&Rigid, &DVec3)| {
            Box3d { center: DVec3::ZERO, size: *size, yaw: 0.0 }.corners().map(|corner| *pose * corner)
        };
        return poses.iter().zip(&sizes).map(corners).collect();
    }
    let yaws: Vec<f64> = match find(&["yaw_global", "heading"]) {
        Some(yaws) => yaws.values.clone(),
        None => find(&["rotation_wxyz_global", "q_wxyz_ego"])
            .unwrap_or_else(|| panic!("{dataset} has no rotations"))
            .rows()
            .iter()
            .map(|wxyz| Rigid::from_wxyz(*wxyz, [0.0; 3]).expect("unit quaternion").yaw())
            .collect(),
    };
    // Boxes given in the world go to ego by the pose of the label time.
    let in_world = find(&["translation_global", "center_global"]).is_some();
    let ego_from_file = per_box(if in_world { reference_pose(golden, dataset) } else { None }, centers.len());
    let corners = |i: usize| {
        let placed = Box3d { center: centers[i], size: sizes[i], yaw: yaws[i] };
        placed.corners().map(|corner| ego_from_file[i].inverse() * corner)
    };
    (0..centers.len()).map(corners).collect()
}

/// `world_from_ego` at label time: one pose, or one for every box.
fn reference_pose(golden: &Golden, dataset: &str) -> Option<Vec<Rigid>> {
    let names = ["global_from_ego_lidar", "city_from_ego_lidar", "global_from_vehicle_frame"];
    golden.find_any(dataset, &names).map(|poses| poses.rigids())
}

/// One pose for each of `count` boxes; none means that nothing moved.
fn per_box(poses: Option<Vec<Rigid>>, count: usize) -> Vec<Rigid> {
    let poses = poses.unwrap_or_else(|| vec![Rigid::IDENTITY]);
    (0..count).map(|i| poses[if poses.len() == 1 { 0 } else { i }]).collect()
}

/// For each box the transform from the frame of its corners to the camera when the picture was taken.
fn cam_from_boxes(golden: &Golden, dataset: &str, name: &str, mode: &str, count: usize) -> Vec<Rigid> {
    if mode == "view" {
        return per_box(Some(golden.get(&format!("{name}/T_cam_world")).rigids()), count);
    }
    let cam_from_ego = golden.get(&format!("{name}/T_ego_cam")).rigids()[0].inverse();
    if mode == "uncompensated" {
        return vec![cam_from_ego; count];
    }
    let names = ["global_from_ego_image", "city_from_ego_image", "global_from_vehicle_image"];
    let image = golden.find_any(name, &names).unwrap_or_else(|| panic!("{name} has no pose of its own")).rigids();
    let reference = reference_pose(golden, dataset).unwrap_or_else(|| panic!("{dataset} has no pose at label time"));
    let chain = |(image, reference): (Rigid, Rigid)| cam_from_ego * image.inverse() * reference;
    per_box(Some(image), count).into_iter().zip(per_box(Some(reference), count)).map(chain).collect()
}

fn check_view(golden: &Golden, dataset: &str, name: &str, mode: &str) {
    let view = format!("{name}/{mode}");
    let item = |item: &str| golden.get(&format!("{view}/{item}"));
    let camera = camera(golden, name);
    let boxes = boxes(golden, dataset);
    let cam_from_box = cam_from_boxes(golden, dataset, name, mode, boxes.len());
    let corners: Vec<DVec3> =
        boxes.iter().zip(&cam_from_box).flat_map(|(corners, pose)| corners.map(|corner| *pose * corner)).collect();
    let expected_corners = item("corners_cam").vec3s();
    assert_close(&corners, &expected_corners, METRES, &view);

    let (pixels, inside) = (item("pixels").vec2s(), item("inside").flags());
    for (i, corner) in expected_corners.iter().enumerate() {
        let exact = if corner.z > 0.1 { formula(&camera, *corner) } else { DVec2::ZERO };
        let error = (exact - pixels[i]).length();
        assert!(error <= 1e-6 * pixels[i].length().max(1.0), "{view}, corner {i}: off by {error} px");
        if !inside[i] {
            continue;
        }
        // Through our own chain, and refused exactly where the formula folded a far-off point into the picture.
        match camera.project(corners[i]) {
            Some(pixel) => assert!((pixel - pixels[i]).length() < 1e-3, "{view}, corner {i}: {pixel}"),
            None => assert!(corner.angle_between(DVec3::Z) > widest_corner(&camera), "{view}, corner {i} is refused"),
        }
    }
    check_flags(golden, &view, &camera, &corners);
}

fn formula(camera: &Camera, point: DVec3) -> DVec2 {
    camera.intrinsics.pixel_from_plane(camera.lens.distort(point).expect("in front of the camera"))
}

/// Angle from the optical axis of the picture corner that lies furthest out.
fn widest_corner(camera: &Camera) -> f64 {
    let (w, h) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
    [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)]
        .map(|(u, v)| camera.unproject(DVec2::new(u, v)).expect("the picture's corner").angle_between(DVec3::Z))
        .into_iter()
        .fold(0.0, f64::max)
}

/// Flags decided from our own corners must be equal: none lies close to a limit.
fn check_flags(golden: &Golden, view: &str, camera: &Camera, corners: &[DVec3]) {
    let (w, h) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
    let expect = |name: &str, ours: Vec<bool>| {
        let expected = golden.get(&format!("{view}/{name}")).flags();
        assert_eq!(ours, expected, "{view}/{name}");
    };
    let in_front: Vec<bool> = corners.iter().map(|c| c.z > 0.1).collect();
    let inside: Vec<bool> =
        corners.iter().map(|c| c.z > 0.1 && camera.intrinsics.contains(formula(camera, *c))).collect();
    let visible: Vec<bool> = corners.iter().zip(&inside).map(|(c, inside)| *inside && c.z > 1.0).collect();
    let all_in_front: Vec<bool> = in_front.chunks(8).map(|b| b.iter().all(|v| *v)).collect();
    let with_front = |b: (&[bool], &bool), rule: fn(&[bool]) -> bool| *b.1 && rule(b.0);
    let any: fn(&[bool]) -> bool = |b| b.contains(&true);
    let all: fn(&[bool]) -> bool = |b| !b.contains(&false);
    expect("vis_any", visible.chunks(8).zip(&all_in_front).map(|b| with_front(b, any)).collect());
    expect("vis_all", visible.chunks(8).zip(&all_in_front).map(|b| with_front(b, all)).collect());
    expect("any_front", corners.chunks(8).map(|b| b.iter().any(|c| c.z > 0.0)).collect());
    expect("in_front", in_front);
    expect("inside", inside);
    if golden.find(&format!("{view}/av2_is_valid")).is_some() {
        let valid = |c: &DVec3| {
            c.z > 0.0 && {
                let p = formula(camera, *c);
                p.x >= 0.0 && p.y >= 0.0 && p.x < w - 1.0 && p.y < h - 1.0
            }
        };
        expect("av2_is_valid", corners.iter().map(valid).collect());
    }
}
