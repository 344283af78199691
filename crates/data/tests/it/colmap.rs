//! The COLMAP reader and writer: fixtures against COLMAP's own text files, broken files, hostile bytes.

mod hostile;

use std::path::{Path, PathBuf};

use data::colmap::{
    Camera, CameraModel, Detail, Image, Model, Point2d, Point3d, TrackElement, read_cameras, read_images, read_points,
};
use data::{DataError, store::Store};
use geometry::Lens;

fn data_folder(inside: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else {
        eprintln!("did not run: RIGSCAPE_DATA is not set");
        return None;
    };
    let path = Path::new(&root).join(inside);
    assert!(path.exists(), "RIGSCAPE_DATA is set, but {} does not exist", path.display());
    Some(path)
}

/// A small model with every camera model.
fn made() -> Model {
    let models = [
        CameraModel::SimplePinhole([30.0, 32.0, 18.0]),
        CameraModel::Pinhole([30.0, 31.0, 32.0, 18.0]),
        CameraModel::SimpleRadial([30.0, 32.0, 18.0, 0.1]),
        CameraModel::Radial([30.0, 32.0, 18.0, 0.1, -0.02]),
        CameraModel::OpenCv([30.0, 31.0, 32.0, 18.0, 0.1, -0.02, 0.003, -0.004]),
        CameraModel::OpenCvFisheye([30.0, 31.0, 32.0, 18.0, 0.1, -0.02, 0.003, -0.004]),
    ];
    let image = |id: u32| Image {
        id,
        rotation_wxyz: [0.5, -0.5, 0.5, 0.5],
        translation: [f64::from(id), -2.0, 1e-3],
        camera_id: 11 + id % 6,
        name: format!("camera-{}/{}.jpeg", id % 6, 100 + id),
        points: vec![
            Point2d { xy: [1.5, 2.5], point3d_id: Some(7) },
            Point2d { xy: [f64::from(id), 0.0], point3d_id: None },
        ],
    };
    let images: Vec<Image> = [3, 1, 8, 2, 5, 4].map(image).into();
    let track = images.iter().map(|image| TrackElement { image_id: image.id, point2d_index: 0 }).collect();
    Model {
        cameras: (11..).zip(models).map(|(id, model)| Camera { id, width: 64, height: 36, model }).collect(),
        images,
        points: vec![Point3d { id: 7, xyz: [1.0, -2.0, 3.5], rgb: [1, 2, 255], error: -1.0, track }],
    }
}

fn read(folder: &Path, detail: Detail) -> Result<Model, DataError> {
    Model::read(&Store::open(folder)?, "", detail)
}

fn without_tracks(mut model: Model) -> Model {
    model.images.iter_mut().for_each(|image| image.points.clear());
    model.points.iter_mut().for_each(|point| point.track.clear());
    model
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    made().write(folder.path()).unwrap();
    assert_eq!(read(folder.path(), Detail::Whole).unwrap(), made());
    assert_eq!(read(folder.path(), Detail::WithoutTracks).unwrap(), without_tracks(made()));
    Model::default().write(folder.path()).unwrap();
    assert_eq!(read(folder.path(), Detail::Whole).unwrap(), Model::default());
    let error = made().write(&folder.path().join("absent")).unwrap_err();
    assert!(matches!(error, DataError::Io { .. }) && error.to_string().ends_with("cameras.bin"), "{error}");
}

#[test]
fn models_become_lenses_with_unmoved_pixel_centres() {
    let straight = [0.0; 2];
    let want = [
        ([30.0, 30.0], Lens::Pinhole),
        ([30.0, 31.0], Lens::Pinhole),
        ([30.0, 30.0], Lens::BrownConrady { k: [0.1, 0.0, 0.0], p: straight }),
        ([30.0, 30.0], Lens::BrownConrady { k: [0.1, -0.02, 0.0], p: straight }),
        ([30.0, 31.0], Lens::BrownConrady { k: [0.1, -0.02, 0.0], p: [0.003, -0.004] }),
        ([30.0, 31.0], Lens::KannalaBrandt { k: [0.1, -0.02, 0.003, -0.004] }),
    ];
    for ((camera, ([fx, fy], lens)), id) in made().cameras.iter().zip(want).zip(0..) {
        let i = camera.intrinsics();
        assert_eq!((camera.model.lens(), camera.model.id()), (lens, id));
        assert_eq!([i.fx, i.fy, i.cx, i.cy], [fx, fy, 32.0, 18.0]);
        // The general form of the same lens.
        let again = CameraModel::of(&i, &lens).unwrap();
        assert_eq!(again.lens(), lens);
    }
    let sixth_order = Lens::BrownConrady { k: [0.1, 0.0, 1e-3], p: straight };
    assert_eq!(CameraModel::of(&made().cameras[0].intrinsics(), &sixth_order), None);
}

/// Numbers of a text file's rows without comments, names kept as text.
fn rows(path: &Path) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(path).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.split_whitespace().map(ToOwned::to_owned).collect()).collect()
}

fn number(cell: &str) -> f64 {
    cell.parse().unwrap()
}

#[test]
fn the_fixtures_hold_what_colmaps_text_files_say() {
    let Some(root) = data_folder("wayve101") else { return };
    for (scene, image_count, point_count) in [("scene_901", 20, 352), ("scene_902", 15, 237)] {
        let (binary, text) = (root.join(scene).join("colmap_sparse/rig"), root.join(scene).join("colmap_sparse_txt"));
        let model = read(&binary, Detail::Whole).unwrap();
        assert_eq!((model.cameras.len(), model.images.len(), model.points.len()), (5, image_count, point_count));
        for (camera, row) in model.cameras.iter().zip(rows(&text.join("cameras.txt"))) {
            let name = if camera.model.id() == 5 { "OPENCV_FISHEYE" } else { "OPENCV" };
            assert_eq!(row[..4], [&camera.id.to_string(), name, "1920", "1080"]);
            assert_eq!(camera.model.params(), row[4..].iter().map(|cell| number(cell)).collect::<Vec<_>>());
        }
        let lines = rows(&text.join("images.txt"));
        assert_eq!(lines.len(), 2 * image_count);
        for pair in lines.chunks(2) {
            let image = model.images.iter().find(|image| image.id.to_string() == pair[0][0]).unwrap();
            let pose: Vec<f64> = pair[0][1..8].iter().map(|cell| number(cell)).collect();
            let own = [&image.rotation_wxyz[..], &image.translation].concat();
            assert!(own.iter().zip(&pose).all(|(a, b)| (a - b).abs() < 1e-14), "{own:?} against {pose:?}");
            assert_eq!([&image.camera_id.to_string(), &image.name], [&pair[0][8], &pair[0][9]]);
            assert_eq!(image.points.len() * 3, pair[1].len());
            for (point, cells) in image.points.iter().zip(pair[1].chunks(3)) {
                assert!(
                    (point.xy[0] - number(&cells[0])).abs() < 1e-9 && (point.xy[1] - number(&cells[1])).abs() < 1e-9
                );
                assert_eq!(point.point3d_id.map_or("-1".to_owned(), |id| id.to_string()), cells[2]);
            }
        }
        for row in rows(&text.join("points3D.txt")) {
            let point = model.points.iter().find(|point| point.id.to_string() == row[0]).unwrap();
            assert!((0..3).all(|i| (point.xyz[i] - number(&row[1 + i])).abs() < 1e-12));
            assert_eq!(point.rgb.map(|value| value.to_string())[..], row[4..7]);
            let track: Vec<String> =
                point.track.iter().flat_map(|t| [t.image_id.to_string(), t.point2d_index.to_string()]).collect();
            assert_eq!(track, row[8..]);
        }
    }
}

#[test]
fn writing_the_fixtures_gives_their_bytes() {
    let Some(root) = data_folder("wayve101") else { return };
    for scene in ["scene_901", "scene_902"] {
        let folder = root.join(scene).join("colmap_sparse/rig");
        let model = read(&folder, Detail::Whole).unwrap();
        for (name, bytes) in model.to_bytes() {
            assert!(bytes == std::fs::read(folder.join(name)).unwrap(), "{scene}/{name}");
        }
        assert_eq!(read(&folder, Detail::WithoutTracks).unwrap(), without_tracks(model));
    }
}

#[test]
fn links_that_lead_nowhere_and_repeated_keys_are_found() {
    let outcome = |change: fn(&mut Model)| {
        let folder = tempfile::tempdir().unwrap();
        let mut model = made();
        change(&mut model);
        model.write(folder.path()).unwrap();
        let error = read(folder.path(), Detail::Whole).unwrap_err();
        match &error {
            DataError::Dangling { table, field, token, path } => {
                format!("{table} {token} {field} {}", path.file_name().unwrap().display())
            }
            DataError::DuplicateToken { table, token, path } => {
                format!("{table} {token} twice {}", path.file_name().unwrap().display())
            }
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(outcome(|m| m.images[2].camera_id = 99), "images camera-2/108.jpeg camera_id images.bin");
    assert_eq!(
        outcome(|m| m.images[0].points[1].point3d_id = Some(8)),
        "images camera-3/103.jpeg point3D_id images.bin"
    );
    assert_eq!(outcome(|m| m.points[0].track[0].image_id = 6), "points3D 7 track points3D.bin");
    assert_eq!(outcome(|m| m.points[0].track[0].point2d_index = 2), "points3D 7 track points3D.bin");
    assert_eq!(outcome(|m| m.cameras[1].id = 11), "cameras 11 twice cameras.bin");
    assert_eq!(outcome(|m| m.images[1].id = 3), "images 3 twice images.bin");
    assert_eq!(outcome(|m| m.images[1].name = "camera-3/103.jpeg".into()), "images camera-3/103.jpeg twice images.bin");
    assert_eq!(outcome(|m| m.points.push(m.points[0].clone())), "points3D 7 twice points3D.bin");
}

#[test]
fn single_files_name_the_byte() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.bin");
    let write = |bytes: &[u8]| std::fs::write(&path, bytes).unwrap();
    let [(_, cameras), (_, images), (_, points)] = made().to_bytes();
    write(&[&cameras[..], &[0]].concat());
    let error = read_cameras(&path.clone().into()).unwrap_err().to_string();
    assert!(
        error.contains("1 bytes follow the last record") && error.contains(&format!("byte {}", cameras.len())),
        "{error}"
    );
    write(&cameras[..cameras.len() - 3]);
    let error = read_cameras(&path.clone().into()).unwrap_err();
    assert!(matches!(error, DataError::Truncated { offset, .. } if offset as usize == cameras.len() - 3), "{error}");
    let mut long_name = images.clone();
    long_name.splice(8 + 64..8 + 64, [b'a'; 5000]);
    write(&long_name);
    let error = read_images(&path.clone().into(), Detail::Whole).unwrap_err().to_string();
    assert!(error.contains("longer than 4096") && error.contains("byte 72"), "{error}");
    let mut no_text = images.clone();
    no_text[8 + 64] = 0xFF;
    write(&no_text);
    assert!(read_images(&path.clone().into(), Detail::Whole).unwrap_err().to_string().contains("UTF-8"));
    let mut not_finite = points.clone();
    not_finite[16..24].copy_from_slice(&f64::INFINITY.to_le_bytes());
    write(&not_finite);
    let error = read_points(&path.clone().into(), Detail::Whole).unwrap_err().to_string();
    assert!(error.contains("point 7") && error.contains("byte 8") && error.ends_with("x.bin"), "{error}");
    let mut wide = cameras.clone();
    wide[16..24].copy_from_slice(&(1_u64 << 40).to_le_bytes());
    write(&wide);
    assert!(read_cameras(&path.clone().into()).unwrap_err().to_string().contains("which nothing can hold"));
    let absent = read_points(&folder.path().join("absent.bin").into(), Detail::Whole).unwrap_err();
    assert!(matches!(absent, DataError::Missing { .. }), "{absent:?}");
}
