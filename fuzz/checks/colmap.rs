//! The first byte chooses one of the three files. It is refused, or read whole and written back byte for byte; reading without
//! tracks never accepts less than reading whole.

use std::path::PathBuf;
use std::sync::LazyLock;

use data::colmap::{Detail, read_cameras, read_images, read_points, write_cameras, write_images, write_points};
use data::store::StoredFile;
use tempfile::NamedTempFile;

/// Readers read files, so the bytes go through one.
static SCRATCH: LazyLock<NamedTempFile> = LazyLock::new(|| NamedTempFile::new().expect("a writable folder"));

/// What must hold for any bytes.
pub fn check(bytes: &[u8]) {
    let Some((kind, bytes)) = bytes.split_first() else { return };
    std::fs::write(SCRATCH.path(), bytes).expect("a writable folder");
    let file = StoredFile::from(PathBuf::from(SCRATCH.path()));
    match kind % 3 {
        0 => {
            if let Ok(cameras) = read_cameras(&file) {
                assert_eq!(write_cameras(&cameras), bytes);
                drop(cameras.iter().map(|camera| (camera.intrinsics(), camera.model.lens())).collect::<Vec<_>>());
            }
        }
        1 => {
            if let Ok(images) = read_images(&file, Detail::Whole) {
                assert_eq!(write_images(&images), bytes);
                assert!(images.iter().all(|image| image.cam_from_world().is_ok()));
                assert_eq!(read_images(&file, Detail::WithoutTracks).expect("less than whole").len(), images.len());
            }
        }
        _ => {
            if let Ok(points) = read_points(&file, Detail::Whole) {
                assert_eq!(write_points(&points), bytes);
                assert_eq!(read_points(&file, Detail::WithoutTracks).expect("less than whole").len(), points.len());
            }
        }
    }
}
