//! Pixels and matrices of a batch.

use std::path::Path;

use data::{
    AugmentConfig, DataError, ImageSize, ImageSource, PadViews, PoseMode, RigMotion, Sample, SampleOptions, SceneBatch,
    SceneDataset, ViewArrays, assemble, novel_targets, rerig,
};
use geometry::glam::{DMat3, DVec2, DVec3};
use geometry::{Camera, CameraRig, Lens, RigCamera};
use image::{Rgb, RgbImage};

use super::fake::{RAW, Ring, car, dot, ring_pose};

const SIZE: ImageSize = ImageSize { height: 24, width: 32 };

fn options(pose_mode: PoseMode) -> SampleOptions {
    SampleOptions { size: SIZE, pose_mode }
}

fn sample(dataset: &dyn SceneDataset, index: usize) -> Sample {
    Sample::load(&dataset.frame(index).unwrap(), &options(PoseMode::Static)).unwrap()
}

/// Everything that belongs to one view, as bit patterns.
fn view_bits(arrays: &ViewArrays, b: usize, v: usize) -> Vec<u32> {
    let at = b * arrays.views + v;
    let part = |data: &[f32], len: usize| data[at * len..][..len].iter().map(|x| x.to_bits()).collect::<Vec<u32>>();
    let mut bits = vec![u32::from(arrays.mask[at])];
    bits.extend(part(&arrays.images, 3 * arrays.height * arrays.width));
    for (data, len) in [(&arrays.k, 9), (&arrays.ego_from_cam, 16), (&arrays.img_from_raw, 9)] {
        bits.extend(part(data, len));
    }
    bits.extend(part(&arrays.img_from_ego, 12));
    bits.extend(part(&arrays.ego_from_img, 12));
    bits
}

fn apply(matrix: &[f32], at: usize, p: [f32; 4]) -> [f32; 3] {
    std::array::from_fn(|r| (0..4).map(|c| matrix[at * 12 + r * 4 + c] * p[c]).sum())
}

#[test]
fn rigs_of_4_6_and_7_cameras_share_a_batch_without_touching_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let rings = [("four", 4), ("six", 6), ("seven", 7)].map(|(name, views)| Ring::new(folder.path(), name, views, 1));
    let together = assemble(rings.iter().map(|r| sample(r, 0)).collect(), PadViews::Largest).unwrap();
    assert_eq!((together.input.batch, together.input.views), (3, 7));
    let padding = ViewArrays::padding(1, 1, SIZE);
    for (b, ring) in rings.iter().enumerate() {
        let alone = assemble(vec![sample(ring, 0)], PadViews::To(9)).unwrap();
        assert_eq!(alone.input.views, 9);
        for v in 0..7 {
            let bits = view_bits(&together.input, b, v);
            assert_eq!(bits, view_bits(&alone.input, 0, v), "sample {b} view {v}");
            assert_eq!(bits == view_bits(&padding, 0, 0), v >= ring.views, "sample {b} view {v}");
        }
        assert_eq!(together.channels[b].len(), ring.views);
    }
    let too_many = assemble(rings.iter().map(|r| sample(r, 0)).collect(), PadViews::To(6));
    assert!(matches!(too_many, Err(DataError::Config(_))));
}

#[test]
fn padding_is_black_and_identity() {
    let arrays = ViewArrays::padding(2, 3, SIZE);
    assert_eq!(arrays.images.len(), 2 * 3 * 3 * 24 * 32);
    assert!(arrays.images.iter().chain(&arrays.img_from_ego).chain(&arrays.ego_from_img).all(|x| *x == 0.0));
    assert!(arrays.mask.iter().all(|m| !m));
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    assert!(arrays.k.chunks(9).chain(arrays.img_from_raw.chunks(9)).all(|m| m == identity));
    assert_eq!(arrays.ego_from_cam.len(), 6 * 16);
    for pose in arrays.ego_from_cam.chunks(16) {
        assert_eq!(pose, [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.]);
    }
}

#[test]
fn an_absent_picture_is_a_masked_view() {
    let folder = tempfile::tempdir().unwrap();
    let mut ring = Ring::new(folder.path(), "ring", 3, 1);
    ring.absent = vec![1];
    let batch = assemble(vec![sample(&ring, 0)], PadViews::Largest).unwrap();
    assert_eq!(batch.input.mask, [true, false, true]);
    assert_eq!(batch.input, batch.target);
    assert_eq!(view_bits(&batch.input, 0, 1), view_bits(&ViewArrays::padding(1, 1, SIZE), 0, 0));
}

#[test]
fn matrices_invert_each_other_in_f32() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 5, 1);
    let mut flipped = sample(&ring, 0);
    AugmentConfig { flip_probability: 1.0, ..Default::default() }.apply(&mut flipped, 1, 0);
    let arrays = assemble(vec![flipped], PadViews::Largest).unwrap().input;
    let mut worst = 0.0f32;
    for v in 0..5 {
        for (u, w, z) in [(0.5, 0.5, 1.0), (31.5, 3.25, 20.0), (12.0, 23.5, 60.0), (16.0, 12.0, 100.0)] {
            let ego = apply(&arrays.ego_from_img, v, [u * z, w * z, z, 1.0]);
            let back = apply(&arrays.img_from_ego, v, [ego[0], ego[1], ego[2], 1.0]);
            let again = apply(&arrays.ego_from_img, v, [back[0], back[1], back[2], 1.0]);
            let error = (0..3).map(|i| (ego[i] - again[i]).abs()).fold(0.0, f32::max);
            worst = worst.max(error);
            assert!((back[2] - z).abs() < 1e-3 && (back[0] / back[2] - u).abs() < 1e-3, "{back:?}");
        }
    }
    assert!(worst < 1e-3, "{worst} m");
}

/// A dataset of one frame whose pictures are black but for the pixel that shows `point`; returns it with those pixels' views.
fn dots(folder: &Path, point: DVec3) -> (Ring, Vec<usize>) {
    let ring = Ring::new(folder, "dots", 6, 1);
    let mut seen = vec![];
    for view in 0..6 {
        let camera = Camera::new(RAW, Lens::Pinhole).unwrap();
        let pixel = camera.project(ring.ego_from_cam(view).inverse() * point).filter(|p| RAW.contains(*p));
        match pixel {
            Some(pixel) => {
                dot(&ring.path(0, view), pixel);
                seen.push(view);
            }
            None => RgbImage::new(RAW.width, RAW.height).save(ring.path(0, view)).unwrap(),
        }
    }
    (ring, seen)
}

/// Brightest pixel (column, row) of one view.
fn brightest(arrays: &ViewArrays, v: usize) -> (usize, usize) {
    let plane = &arrays.images[v * 3 * arrays.height * arrays.width..][..arrays.height * arrays.width];
    let at = (0..plane.len()).max_by(|a, b| plane[*a].total_cmp(&plane[*b])).unwrap();
    (at % arrays.width, at / arrays.width)
}

#[test]
fn every_augmentation_moves_matrices_with_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let point = DVec3::new(9.0, 6.0, 1.0);
    let (ring, seen) = dots(folder.path(), point);
    assert!(!seen.is_empty());
    let augment = AugmentConfig {
        flip_probability: 0.5,
        rig_motion: RigMotion { probability: 0.7, ..RigMotion::default() },
        ..Default::default()
    };
    let (mut flips, mut moves) = (0, 0);
    for item in 0..40 {
        let mut changed = sample(&ring, 0);
        let before = changed.target[0].ego_from_cam;
        augment.apply(&mut changed, 3, item);
        let motion = changed.target[0].ego_from_cam * before.inverse();
        let moved = motion * point;
        moves += usize::from(moved.distance(point) > 1e-9);
        let batch = assemble(vec![changed], PadViews::Largest).unwrap();
        for arrays in [&batch.input, &batch.target] {
            for v in seen.iter().copied() {
                let q = apply(&arrays.img_from_ego, v, [moved.x as f32, moved.y as f32, moved.z as f32, 1.0]);
                let pixel = ((q[0] / q[2]) as usize, (q[1] / q[2]) as usize);
                assert_eq!(pixel, brightest(arrays, v), "item {item} view {v}");
            }
        }
        flips += batch.input.img_from_raw.chunks(9).filter(|m| m[0] < 0.0).count();
        assert_eq!(batch.input.ego_from_cam, batch.target.ego_from_cam, "the motion is common to both");
    }
    assert!((60..180).contains(&flips) && (15..40).contains(&moves), "{flips} flips, {moves} motions");
}

/// Trap 8 of the BEV-VAE specification: the flipped matrix must not reach the clean target.
#[test]
fn the_target_is_never_mirrored() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 4, 1);
    let clean = assemble(vec![sample(&ring, 0)], PadViews::Largest).unwrap();
    let mut flipped = sample(&ring, 0);
    AugmentConfig { flip_probability: 1.0, grayscale_probability: 0.0, ..Default::default() }.apply(&mut flipped, 1, 0);
    let flipped = assemble(vec![flipped], PadViews::Largest).unwrap();
    assert_eq!(flipped.target, clean.target);
    // [[-1, 0, W], [0, 1, 0], [0, 0, 1]] times the resize diag(32/64, 24/48, 1).
    assert_eq!(flipped.input.img_from_raw[..9], [-0.5, 0.0, 32.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]);
    assert_eq!(flipped.target.img_from_raw[..9], [0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]);
    for (mirrored, row) in flipped.input.images.chunks(32).zip(clean.input.images.chunks(32)) {
        assert!(mirrored.iter().eq(row.iter().rev()));
    }
    assert_ne!(flipped.input.images, clean.input.images);
}

#[test]
fn dropped_views_stay_targets_and_one_always_remains() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 4, 1);
    let clean = assemble(vec![sample(&ring, 0)], PadViews::Largest).unwrap();
    let left = |probability, item| -> SceneBatch {
        let mut changed = sample(&ring, 0);
        AugmentConfig { drop_view_probability: probability, ..Default::default() }.apply(&mut changed, 1, item);
        assemble(vec![changed], PadViews::Largest).unwrap()
    };
    let mut kept = std::collections::BTreeSet::new();
    for item in 0..30 {
        let batch = left(1.0, item);
        assert_eq!(batch.target, clean.target);
        assert_eq!(batch.input.mask.iter().filter(|m| **m).count(), 1);
        kept.insert(batch.input.mask.iter().position(|m| *m));
    }
    assert_eq!(kept.len(), 4, "any view may be the one that stays");
    let total: usize = (0..100).map(|item| left(0.25, item).input.mask.iter().filter(|m| **m).count()).sum();
    // One of four is safe, the others go with 1/4: 325 expected, standard deviation 7.5.
    assert!((295..355).contains(&total), "{total}");
}

#[test]
fn nothing_happens_by_default() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 4, 1);
    let clean = assemble(vec![sample(&ring, 0)], PadViews::Largest).unwrap();
    let mut same = sample(&ring, 0);
    AugmentConfig::default().apply(&mut same, 1, 0);
    assert_eq!(assemble(vec![same], PadViews::Largest).unwrap(), clean);
    let pixel = |v: usize, c: usize, y: usize, x: usize| clean.input.images[((v * 3 + c) * 24 + y) * 32 + x];
    // The mean of the four raw pixels (2x, 2y) .. (2x + 1, 2y + 1), at most half a step off by rounding.
    let raw = image::open(ring.path(0, 2)).unwrap().to_rgb8();
    let mean: f32 = [(8, 10), (9, 10), (8, 11), (9, 11)].iter().map(|(x, y)| f32::from(raw.get_pixel(*x, *y)[1])).sum();
    assert!((pixel(2, 1, 5, 4) - mean / 4.0 / 255.0).abs() <= 0.51 / 255.0);
}

#[test]
fn compensated_poses_follow_the_car() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 3, 2);
    let frame = ring.frame(1).unwrap();
    let pose = |mode, v: usize| Sample::load(&frame, &options(mode)).unwrap().input[v].ego_from_cam;
    for v in 0..3 {
        assert_eq!(pose(PoseMode::Static, v), ring.ego_from_cam(v));
        let expected = car(0.5).inverse() * car(0.5 + 0.01 * v as f64) * ring.ego_from_cam(v);
        assert!(pose(PoseMode::Compensated, v).translation.distance(expected.translation) < 1e-9);
    }
    let shift = pose(PoseMode::Compensated, 2).translation - pose(PoseMode::Static, 2).translation;
    assert!((shift.length() - 0.2).abs() < 0.01, "10 m/s for 20 ms: {shift}");
}

/// A smooth colour for every direction, so that pictures through any lens can be painted exactly.
fn tone(ray: DVec3) -> [f64; 3] {
    let (x, y) = (ray.x / ray.z, ray.y / ray.z);
    [(3.0 * x).sin(), (4.0 * y).sin(), (2.0 * (x + y)).cos()].map(|s| 127.5 + 100.0 * s)
}

#[test]
fn distorted_pictures_become_pinhole_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let lenses = [
        Lens::BrownConrady { k: [-0.3, 0.1, -0.02], p: [0.002, -0.001] },
        Lens::KannalaBrandt { k: [0.05, -0.01, 0.002, 0.0] },
    ];
    for (i, lens) in lenses.into_iter().enumerate() {
        let camera = Camera::new(RAW, lens).unwrap();
        let path = folder.path().join(format!("{i}.png"));
        let picture = RgbImage::from_fn(RAW.width, RAW.height, |x, y| {
            let ray = camera.unproject(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            Rgb(ray.map_or([0; 3], |ray| tone(ray).map(|t| t.round() as u8)))
        });
        picture.save(&path).unwrap();
        let ring = Ring::new(folder.path(), "lens", 1, 1);
        let mut frame = ring.frame(0).unwrap();
        frame.views[0].lens = lens;
        frame.views[0].image = Some(ImageSource::File { file: path.into(), size: (RAW.width, RAW.height) });
        let view = &Sample::load(&frame, &options(PoseMode::Static)).unwrap().target[0];
        let cam_from_img: DMat3 = (view.edit.img_from_raw * view.k).inverse();
        let image = view.image.as_ref().unwrap();
        let (mut worst, mut compared) = (0.0f64, 0);
        for y in 1..23 {
            for x in 1..31 {
                let ray = cam_from_img * DVec3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0);
                let margin = 3.0;
                let inside = camera
                    .project(ray)
                    .is_some_and(|p| p.x > margin && p.y > margin && p.x < 64.0 - margin && p.y < 48.0 - margin);
                if inside {
                    compared += 1;
                    let wanted = tone(ray);
                    for c in 0..3 {
                        let got = f64::from(image[(c * 24 + y) * 32 + x]) * 255.0;
                        worst = worst.max((got - wanted[c]).abs());
                    }
                }
            }
        }
        assert!(compared > 300 && worst < 4.0, "{lens:?}: {worst} of 255 over {compared} pixels");
    }
}

#[test]
fn real_frames_have_no_pictures_for_other_cameras() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 3, 1);
    let frame = ring.frame(0).unwrap();
    let moved = rerig(&frame, &frame.rig().rotated(0.5)).unwrap();
    assert!(moved.views.iter().all(|v| v.image.is_none()));
    assert_eq!(moved.views[1].ego_from_cam, frame.rig().rotated(0.5).cameras[1].ego_from_cam);
    let refused = novel_targets(std::slice::from_ref(&frame), &[frame.rig()], SIZE, PadViews::Largest);
    assert!(matches!(refused, Err(DataError::Unsupported { .. })));
}

#[test]
fn cameras_alone_can_be_decoded() {
    let rig = |count: usize| CameraRig {
        cameras: (0..count)
            .map(|i| RigCamera {
                channel: i.to_string(),
                intrinsics: RAW,
                lens: Lens::Pinhole,
                ego_from_cam: ring_pose(i as f64),
            })
            .collect(),
    };
    let arrays = ViewArrays::cameras(&[rig(2), rig(3)], SIZE, PadViews::Largest).unwrap();
    assert_eq!(arrays.mask, [true, true, false, true, true, true]);
    assert!(arrays.images.iter().all(|x| *x == 0.0));
    // A point on the optical axis of camera 1 lies at its principal point, (cx, cy) halved.
    let point = ring_pose(1.0) * DVec3::new(0.0, 0.0, 10.0);
    let q = apply(&arrays.img_from_ego, 1, [point.x as f32, point.y as f32, point.z as f32, 1.0]);
    assert!((q[2] - 10.0).abs() < 1e-4 && (q[0] / q[2] - 15.5).abs() < 1e-4 && (q[1] / q[2] - 12.75).abs() < 1e-4);
}

#[test]
fn pictures_of_two_sizes_do_not_form_a_batch() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 2, 1);
    let small = SampleOptions { size: ImageSize::square(8), pose_mode: PoseMode::Static };
    let other = Sample::load(&ring.frame(0).unwrap(), &small).unwrap();
    assert!(matches!(assemble(vec![sample(&ring, 0), other], PadViews::Largest), Err(DataError::Config(_))));
    assert!(matches!(assemble(vec![], PadViews::Largest), Err(DataError::Config(_))));
}
