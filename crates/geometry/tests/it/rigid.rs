//! Quaternions, rigid transforms, slerp, pose tracks and picture edits against independent packages.

use geometry::glam::{DMat3, DMat4, DQuat, DVec3};
use geometry::{Camera, GeometryError, ImageEdit, Intrinsics, Lens, PoseTrack, Rigid, wrap_angle};

use crate::golden::{Golden, Tensor};

/// Suggested by the golden for plain f64 arithmetic, relative to the size of the number.
const ALGEBRA: f64 = 1e-12;
/// Suggested for slerp: scipy's own error is 1e-8 for the smallest angles.
const SLERP: f64 = 1e-9;

#[track_caller]
fn assert_numbers(ours: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(ours.len(), expected.len(), "{what}");
    for (a, b) in ours.iter().zip(expected) {
        assert!((a - b).abs() <= tolerance * b.abs().max(1.0), "{what}: {ours:?} instead of {expected:?}");
    }
}

fn row_major3(m: DMat3) -> [f64; 9] {
    m.transpose().to_cols_array()
}

fn row_major4(m: DMat4) -> [f64; 16] {
    m.transpose().to_cols_array()
}

fn turn(wxyz: [f64; 4]) -> Rigid {
    Rigid::from_wxyz(wxyz, [0.0; 3]).expect("unit quaternion")
}

/// Equal as rotations: q and -q are the same.
#[track_caller]
fn assert_same_rotation(ours: [f64; 4], expected: [f64; 4], what: &str) {
    let dot: f64 = ours.iter().zip(&expected).map(|(a, b)| a * b).sum();
    assert_numbers(&ours.map(|v| v * dot.signum()), &expected, ALGEBRA, what);
}

#[test]
fn quaternions() {
    let Some(golden) = Golden::open("rigid") else { return };
    let get = |name: &str| golden.get(&format!("quat/{name}"));
    let quats = |name: &str| get(name).rows::<4>().to_vec();
    let (a, b) = (quats("a_wxyz"), quats("b_wxyz"));
    let (inverse, product, from_matrix) = (quats("a_inverse"), quats("a_times_b"), quats("from_matrix_canonical"));
    let (vectors, rotated) = (get("vector").vec3s(), get("a_rotates_vector").vec3s());
    assert!(!a.is_empty());
    for i in 0..a.len() {
        let (qa, qb) = (turn(a[i]), turn(b[i]));
        let matrix = get("a_matrix").mat3s()[i];
        assert_numbers(&row_major3(qa.rotation_matrix()), &row_major3(matrix), ALGEBRA, "a_matrix");
        assert_same_rotation(qa.inverse().wxyz(), inverse[i], "a_inverse");
        assert_same_rotation((qa * qb).wxyz(), product[i], "a_times_b");
        assert_same_rotation(Rigid::from_mat4(&DMat4::from_mat3(matrix)).wxyz(), from_matrix[i], "from_matrix");
        assert_numbers(&(qa * vectors[i]).to_array(), &rotated[i].to_array(), ALGEBRA, "a_rotates_vector");
        assert_numbers(&[qa.angle_to(&qb)], &[get("angle_between").values[i]], ALGEBRA, "angle_between");
        let axis_angle = Rigid::new(DQuat::from_scaled_axis(get("rotation_vector").vec3s()[i]), DVec3::ZERO);
        if get("rotation_vector_unique").flags()[i] {
            assert!(axis_angle.angle_to(&qa) < ALGEBRA, "rotation_vector {i}");
        }
        // A heading is undefined when x points straight up or down.
        let forward = qa * DVec3::X;
        if forward.truncate().length() > 1e-6 {
            let error = wrap_angle(qa.yaw() - get("yaw_of_a").values[i]).abs();
            assert!(error * forward.truncate().length() < ALGEBRA, "yaw_of_a {i} is off by {error}");
        }
    }
}

#[test]
fn rigid_transforms() {
    let Some(golden) = Golden::open("rigid") else { return };
    let get = |name: &str| golden.get(&format!("se3/{name}"));
    let (a, b) = (get("a").rigids(), get("b").rigids());
    assert!(!a.is_empty());
    for i in 0..a.len() {
        let expect = |ours: Rigid, name: &str| {
            assert_numbers(&row_major4(ours.to_mat4()), &get(name).rows::<16>()[i], ALGEBRA, name);
        };
        expect(a[i], "a");
        expect(a[i] * b[i], "a_b");
        expect(a[i].inverse(), "a_inverse");
        expect(a[i].inverse() * b[i], "a_inverse_b");
        let point = a[i] * get("point").vec3s()[i];
        assert_numbers(&point.to_array(), &get("a_point").rows::<3>()[i], ALGEBRA, "a_point");
    }
}

#[test]
fn slerp_takes_the_shortest_path() {
    let Some(golden) = Golden::open("rigid") else { return };
    let get = |name: &str| golden.get(&format!("slerp/{name}"));
    let amounts = &get("amount").values;
    let (matrices, quats) = (get("matrix").mat3s(), get("quat_same_side_as_a").rows::<4>());
    let pairs = get("a_wxyz").rows::<4>().iter().zip(get("b_wxyz").rows::<4>());
    for (row, (a, b)) in pairs.enumerate() {
        for (column, amount) in amounts.iter().enumerate() {
            let index = row * amounts.len() + column;
            let ours = turn(*a).interpolate(&turn(*b), *amount);
            let what = format!("pair {row} at {amount}");
            assert_numbers(&row_major3(ours.rotation_matrix()), &row_major3(matrices[index]), SLERP, &what);
            assert_numbers(&ours.wxyz(), &quats[index], SLERP, &what);
        }
    }
}

/// Rotations of the golden's track come from a package that mixes linearly above a dot product of 0.9995, which turns by up to
/// 2e-5 rad against slerp; `slerp_takes_the_shortest_path` pins the rotation itself.
const LINEAR_MIX: f64 = 3e-5;

/// The golden clamps outside its rows; ours refuses there, so that no reader extrapolates unknowingly.
#[test]
fn pose_tracks() {
    let Some(golden) = Golden::open("rigid") else { return };
    let get = |name: &str| golden.get(&format!("pose_track/{name}"));
    let nanoseconds = |t: &Tensor| -> Vec<i64> { t.values.iter().map(|us| *us as i64 * 1000).collect() };
    let (times, queries) = (nanoseconds(get("timestamp_us")), nanoseconds(get("query_us")));
    let pose = |i: usize| Rigid::from_wxyz(get("q_wxyz").rows()[i], get("t").rows()[i]).expect("unit quaternion");
    let track = PoseTrack::new((0..times.len()).map(|i| (times[i], pose(i))).collect(), i64::MAX);
    let covered = *times.iter().min().expect("rows")..=*times.iter().max().expect("rows");
    for (query, expected) in queries.iter().zip(get("result").rigids()) {
        match track.at(*query) {
            Ok(pose) => {
                assert!(covered.contains(query));
                assert!(pose.angle_to(&expected) < LINEAR_MIX, "{query}: {pose:?} instead of {expected:?}");
                let (ours, theirs) = (pose.translation.to_array(), expected.translation.to_array());
                assert_numbers(&ours, &theirs, ALGEBRA, "pose_track");
            }
            Err(GeometryError::NoPose { .. }) => assert!(!covered.contains(query), "{query} lies inside {covered:?}"),
            Err(other) => panic!("{other}"),
        }
    }
    assert!(queries.iter().any(|query| covered.contains(query)));
}

#[test]
fn picture_edits_carry_the_intrinsics_along() {
    let Some(golden) = Golden::open("rigid") else { return };
    let k = golden.get("intrinsics/K").mat3s()[0];
    let points = golden.get("intrinsics/points_cam").vec3s();
    let [width, height] = source_size(&golden);
    let raw = Intrinsics { fx: k.x_axis.x, fy: k.y_axis.y, cx: k.z_axis.x, cy: k.z_axis.y, width, height };
    let raw_camera = Camera::new(raw, Lens::Pinhole).expect("sound intrinsics");
    for (point, pixel) in points.iter().zip(golden.get("intrinsics/pixels").rows::<2>()) {
        let ours = raw_camera.project(*point).expect("in front");
        assert_numbers(&ours.to_array(), pixel, ALGEBRA, "raw pixels");
    }
    let cases = golden.prefixes("image_matrix");
    assert!(!cases.is_empty());
    for case in cases {
        let matrix = golden.get(&format!("{case}/image_matrix")).mat3s()[0];
        let edit = edit_like(case, matrix, [width, height]);
        assert_numbers(&row_major3(edit.img_from_raw), &row_major3(matrix), ALGEBRA, case);
        let edited = edit.intrinsics(&raw);
        assert_numbers(&row_major3(edited.matrix()), &golden.get(&format!("{case}/K")).values, ALGEBRA, case);
        let camera = Camera::new(edited, Lens::Pinhole).expect("sound intrinsics");
        for (point, pixel) in points.iter().zip(golden.get(&format!("{case}/pixels")).rows::<2>()) {
            let ours = camera.project(*point).expect("in front");
            assert_numbers(&ours.to_array(), pixel, ALGEBRA, case);
            let through_raw = edit.apply(raw_camera.project(*point).expect("in front"));
            assert_numbers(&through_raw.to_array(), pixel, ALGEBRA, case);
        }
    }
}

/// `(height, width)` that a case's name states: `dualdiff_224x400`.
fn stated_size(case: &str) -> Option<[u32; 2]> {
    case.split('_').find_map(|part| {
        let (height, width) = part.split_once('x')?;
        Some([height.parse().ok()?, width.parse().ok()?])
    })
}

/// Width and height of the source picture, which the file does not hold: from a case that only stretches.
fn source_size(golden: &Golden) -> [u32; 2] {
    let only_stretches = |case: &&str| {
        let m = golden.get(&format!("{case}/image_matrix")).mat3s()[0];
        m.z_axis.x == 0.0 && m.z_axis.y == 0.0 && stated_size(case).is_some()
    };
    let case = golden.prefixes("image_matrix").into_iter().find(only_stretches).expect("a case without crop");
    let m = golden.get(&format!("{case}/image_matrix")).mat3s()[0];
    let [height, width] = stated_size(case).expect("filtered by it");
    [whole(f64::from(width) / m.x_axis.x) as u32, whole(f64::from(height) / m.y_axis.y) as u32]
}

fn whole(value: f64) -> i64 {
    assert!((value - value.round()).abs() < 1e-6, "{value} should be a whole number");
    value.round() as i64
}

/// The golden's edit rebuilt from resize, crop and flip.
fn edit_like(case: &str, matrix: DMat3, [width, height]: [u32; 2]) -> ImageEdit {
    let mirrored = matrix.x_axis.x < 0.0;
    let resized_width = whole(f64::from(width) * matrix.x_axis.x.abs()) as u32;
    let resized_height = whole(f64::from(height) * matrix.y_axis.y) as u32;
    let [out_height, out_width] = stated_size(case).unwrap_or([resized_height, resized_width]);
    // Mirrored after the crop: u' = out_width - (u - x).
    let x = if mirrored { matrix.z_axis.x - f64::from(out_width) } else { -matrix.z_axis.x };
    let cropped = ImageEdit::identity(width, height).resize(resized_width, resized_height).crop(
        whole(x),
        whole(-matrix.z_axis.y),
        out_width,
        out_height,
    );
    if mirrored { cropped.flip() } else { cropped }
}
