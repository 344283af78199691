//! Latents on disk: what comes back, what a killed run leaves, what is refused.

use std::path::Path;
use std::sync::Arc;

use data::latents::{
    Latent, LatentDataset, LatentFolder, LatentHead, LatentType, LatentWriter, NpyLayout, NpyTree, NpyTreeConfig,
    NpyTreeWriter, Posterior, STATISTICS, TreeKind,
};
use data::{Procedural, ProceduralConfig, SceneDataset, SceneFrame};
use geometry::BevGrid;

const SHAPE: [usize; 3] = [2, 3, 4];
const GRID: BevGrid = BevGrid { x_range: [-8.0, 8.0], y_range: [-8.0, 8.0], z_range: [-1.0, 3.0], cells: [4, 8, 8] };

fn world() -> Procedural {
    let config = ProceduralConfig { scenes: 3, frames_per_scene: 2, ..ProceduralConfig::default() };
    Procedural::open(&config).unwrap()
}

fn head(dtype: LatentType) -> LatentHead {
    LatentHead {
        vae_hash: "hash".to_owned(),
        source_sha256: "settings".to_owned(),
        datasets: vec!["procedural".to_owned()],
        shape: SHAPE,
        dtype,
        grid: GRID,
        shard_samples: 4,
        annotated_only: true,
    }
}

/// Numbers that half precision holds exactly.
fn latent(index: usize) -> Latent {
    let values = |scale: f32| (0..24).map(|at| scale * (index as f32 + at as f32 / 32.0)).collect::<Vec<f32>>();
    Latent { mean: values(1.0), log_var: Some(values(-1.0)) }
}

fn write(folder: &Path, dtype: LatentType, until: usize) -> LatentWriter {
    let world = world();
    let mut writer = LatentWriter::open(folder, head(dtype)).unwrap();
    for index in writer.done()..until {
        writer.add(&world.frame(index).unwrap(), latent(index)).unwrap();
    }
    writer
}

#[test]
fn samples_come_back_with_their_boxes() {
    for dtype in [LatentType::F16, LatentType::F32] {
        let root = tempfile::tempdir().unwrap();
        let written = write(root.path(), dtype, 6).finish(Posterior::Sample).unwrap();
        let opened = LatentFolder::open(root.path()).unwrap();
        assert_eq!((opened.len(), opened.shape()), (6, SHAPE));
        assert_eq!(opened.scene_ranges(), [0..2, 2..4, 4..6], "the last scene is in the second shard");
        assert_eq!(opened.statistics(), written.statistics());
        let world = world();
        for index in [5, 0, 3] {
            assert_eq!(opened.latent(index).unwrap(), latent(index));
            let (got, want) = (opened.frame(index).unwrap(), world.frame(index).unwrap());
            assert_eq!((got.id, got.timestamp_ns), (want.id, want.timestamp_ns));
            let shapes = |frame: Option<Vec<data::ObjectBox>>| {
                frame.unwrap().into_iter().map(|b| (b.box3d, b.class, b.track, b.source_class)).collect::<Vec<_>>()
            };
            assert_eq!(shapes(got.boxes), shapes(want.boxes), "to the last bit");
        }
        let error = opened.latent(6).unwrap_err().to_string();
        assert!(error.contains("no frame 6"), "{error}");
    }
}

#[test]
fn a_killed_run_goes_on_and_ends_in_the_same_files() {
    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write(whole.path(), LatentType::F32, 6).finish(Posterior::Sample).unwrap();
    // Dies in the second shard, with half of a file that was being written.
    drop(write(broken.path(), LatentType::F32, 5));
    std::fs::write(broken.path().join("shard_00001.safetensors.part"), b"half").unwrap();
    let unfinished = LatentFolder::open(broken.path()).unwrap_err().to_string();
    assert!(unfinished.contains("not finished") && unfinished.contains("same command"), "{unfinished}");
    let writer = write(broken.path(), LatentType::F32, 6);
    writer.finish(Posterior::Sample).unwrap();
    for file in ["shard_00000.safetensors", "shard_00001.safetensors", "latents.json", STATISTICS] {
        let read = |root: &tempfile::TempDir| std::fs::read(root.path().join(file)).unwrap();
        assert!(read(&whole) == read(&broken), "{file} differs");
    }
    let again = LatentWriter::open(broken.path(), head(LatentType::F32)).unwrap();
    assert!(again.is_complete() && again.done() == 6);
}

#[test]
fn other_folders_and_damaged_files_are_refused() {
    let root = tempfile::tempdir().unwrap();
    let nothing = LatentFolder::open(root.path()).unwrap_err().to_string();
    assert!(nothing.contains("latents.json") && nothing.contains("rigscape encode"), "{nothing}");
    write(root.path(), LatentType::F16, 6).finish(Posterior::Mean).unwrap();
    let other = LatentHead { vae_hash: "another".to_owned(), ..head(LatentType::F16) };
    let error = LatentWriter::open(root.path(), other).unwrap_err().to_string();
    assert!(error.contains("another autoencoder (hash, not another)"), "{error}");

    let foreign = tempfile::tempdir().unwrap();
    std::fs::write(foreign.path().join("holiday.txt"), b"x").unwrap();
    let error = LatentWriter::open(foreign.path(), head(LatentType::F16)).unwrap_err().to_string();
    assert!(error.contains("not empty"), "{error}");

    let shard = root.path().join("shard_00001.safetensors");
    let bytes = std::fs::read(&shard).unwrap();
    std::fs::write(&shard, &bytes[..bytes.len() - 1]).unwrap();
    let cut = LatentFolder::open(root.path()).unwrap_err().to_string();
    assert!(cut.contains("shard_00001"), "{cut}");
    // A header that promises more than the file has, and one of a gigabyte.
    for change in [b'9', 0xff] {
        let mut bad = bytes.clone();
        if change == 0xff {
            bad[3] = change
        } else {
            bad[bytes.iter().position(|b| *b == b'4').unwrap()] = change
        }
        std::fs::write(&shard, &bad).unwrap();
        let error = LatentFolder::open(root.path()).unwrap_err().to_string();
        assert!(error.contains("shard_00001"), "{error}");
    }
    std::fs::write(&shard, &bytes).unwrap();
    std::fs::write(root.path().join(STATISTICS), b"{}").unwrap();
    let error = LatentFolder::open(root.path()).unwrap_err().to_string();
    assert!(error.contains(STATISTICS), "{error}");
}

#[test]
fn numbers_that_cannot_be_kept_are_refused() {
    let root = tempfile::tempdir().unwrap();
    let frame = world().frame(0).unwrap();
    let mut writer = LatentWriter::open(root.path(), head(LatentType::F16)).unwrap();
    for (value, want) in [(f32::NAN, "not finite"), (1e6, "f32")] {
        let mut bad = latent(0);
        bad.mean[5] = value;
        let error = writer.add(&frame, bad).unwrap_err().to_string();
        assert!(error.contains(want) && error.contains("shard_00000"), "{error}");
    }
    let short = Latent { mean: vec![0.0; 23], log_var: None };
    assert!(writer.add(&frame, short).unwrap_err().to_string().contains("23 numbers"));
}

fn tree(root: &Path, layout: Option<NpyLayout>) -> NpyTreeConfig {
    NpyTreeConfig { root: root.to_owned(), split: "train".to_owned(), kind: TreeKind::BevLidar, layout }
}

#[test]
fn trees_are_written_and_joined_on_the_exact_instant() {
    let world: Arc<dyn SceneDataset> = Arc::new(world());
    let frames: Vec<SceneFrame> = (0..6).map(|index| world.frame(index).unwrap()).collect();
    for layout in [NpyLayout::Tokens, NpyLayout::Chw, NpyLayout::Hwc, NpyLayout::MomentsTokens] {
        let root = tempfile::tempdir().unwrap();
        let writer = NpyTreeWriter::new(tree(root.path(), Some(layout)), SHAPE, LatentType::F16).unwrap();
        for (index, frame) in frames.iter().enumerate() {
            assert!(!writer.has(frame));
            writer.add(frame, &latent(index)).unwrap();
            assert!(writer.has(frame));
        }
        // All shapes here have one reading only.
        let read = NpyTree::open(tree(root.path(), None), SHAPE, world.clone()).unwrap();
        assert_eq!((read.len(), read.scene_ranges().len()), (6, 3));
        for index in [4, 1] {
            let got = read.latent(index).unwrap();
            assert_eq!(got.mean, latent(index).mean, "{layout:?}");
            assert_eq!(got.log_var.is_some(), layout == NpyLayout::MomentsTokens);
            assert_eq!(read.frame(index).unwrap().id, frames[index].id);
        }
        let stamp = frames[3].timestamp_ns;
        let folder = root.path().join("bev-lidar/train").join(&frames[3].id.scene);
        std::fs::rename(folder.join(format!("{stamp}.npy")), folder.join(format!("{}.npy", stamp + 1))).unwrap();
        let missing = NpyTree::open(tree(root.path(), None), SHAPE, world.clone()).unwrap_err().to_string();
        assert!(missing.contains(&format!("{stamp}.npy")), "{missing}");
        std::fs::copy(folder.join(format!("{}.npy", stamp + 1)), folder.join(format!("{stamp}.npy"))).unwrap();
        let extra = NpyTree::open(tree(root.path(), None), SHAPE, world.clone()).unwrap_err().to_string();
        assert!(extra.contains(&format!("{}.npy", stamp + 1)), "{extra}");
    }
}
