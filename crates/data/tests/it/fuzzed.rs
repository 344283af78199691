//! Replays the seeds and finds of the fuzz targets: what holds for any bytes holds for these on every change, without a fuzzer.

use std::path::Path;

#[path = "../../../../fuzz/checks/colmap.rs"]
mod colmap;
#[path = "../../../../fuzz/checks/npy.rs"]
mod npy;
#[path = "../../../../fuzz/checks/npz.rs"]
mod npz;
#[path = "../../../../fuzz/checks/pickle.rs"]
mod pickle;
#[path = "../../../../fuzz/checks/tfrecord.rs"]
mod tfrecord;
#[path = "../../../../fuzz/checks/wkb.rs"]
mod wkb;

/// Runs the check on every committed file of a target.
fn replay(target: &str, check: fn(&[u8])) {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz");
    for (folder, least) in [("seeds", 7), ("found", 1)] {
        let folder = fuzz.join(folder).join(target);
        let files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        assert!(files.len() >= least, "{} holds {} files", folder.display(), files.len());
        files.iter().for_each(|file| check(&std::fs::read(file).unwrap()));
    }
}

#[test]
fn colmap_models() {
    replay("colmap", colmap::check);
}

#[test]
fn numpy_arrays_and_archives() {
    replay("npy", npy::check);
    replay("npz", npz::check);
}

#[test]
fn pickles() {
    replay("pickle", pickle::check);
}

#[test]
fn record_files() {
    replay("tfrecord", tfrecord::check);
}

#[test]
fn geometry_cells() {
    replay("wkb", wkb::check);
}
