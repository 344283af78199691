//! The fixture archives, and the fixture folder packed in every form.

use std::path::{Path, PathBuf};

use data::nuscenes::{FrameChoice, NuScenes, NuScenesConfig};
use data::store::{Root, Roots, Store, index_archive};
use data::{DataError, ImageSource, SceneDataset, SceneFrame, View};

use super::super::nuscenes::folder;
use super::{all_files, borrowed, deflated, files_below, roots, stored, tar_bytes, variant, write, zip_bytes};

fn chain(root: impl Into<Roots>, scene: &str, frames: FrameChoice) -> NuScenesConfig {
    NuScenesConfig { scenes: vec![scene.to_owned()], frames, ..NuScenesConfig::new(root, "v1.0-mini") }
}

fn bytes(view: &View) -> Option<Vec<u8>> {
    match view.image.as_ref()? {
        ImageSource::File { file, .. } => Some(file.bytes().unwrap()),
        _ => None,
    }
}

/// Everything but the pictures' places is equal, and the pictures are byte-identical; returns how many.
fn same_frames(a: &NuScenes, b: &NuScenes) -> usize {
    assert_eq!((a.len(), a.scenes()), (b.len(), b.scenes()));
    let pairs = (0..a.len()).map(|index| (a.frame(index).unwrap(), b.frame(index).unwrap()));
    pairs.map(|(a, b)| same_frame(&a, &b)).sum()
}

fn same_frame(a: &SceneFrame, b: &SceneFrame) -> usize {
    assert_eq!((&a.id, a.timestamp_ns, a.world_from_ego), (&b.id, b.timestamp_ns, b.world_from_ego));
    assert_eq!((&a.boxes, &a.scene_text, a.rig()), (&b.boxes, &b.scene_text, b.rig()));
    let mut pictures = 0;
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((a.timestamp_ns, a.world_from_ego), (b.timestamp_ns, b.world_from_ego));
        assert_eq!(bytes(a), bytes(b), "{}", a.channel);
        if let Some(b) = &b.image {
            b.inspect().unwrap();
            pictures += 1;
        }
    }
    pictures
}

#[test]
fn the_fixture_archives_give_the_frames_of_the_folder() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let archive = |name: &str| root.join("archives").join(name);
    let [meta, blobs, keys] =
        ["nuscenes_chain_meta.zip", "nuscenes_chain_blobs_stored.zip", "nuscenes_chain_keyframes.tar"].map(archive);
    for (pictures, frames, want) in [
        (&blobs, FrameChoice::all_pictures(), 78),
        (&blobs, FrameChoice::KeyFrames, 18),
        (&keys, FrameChoice::KeyFrames, 18),
    ] {
        let open = |roots: Roots| NuScenes::open(&chain(roots, "scene-0655", frames)).unwrap();
        let from_folder = open(root.join("nuscenes_chain").into());
        assert_eq!(same_frames(&from_folder, &open(roots([meta.clone(), pictures.clone()]))), want);
        // Tables from the folder, pictures from the archive.
        let tables = tempfile::tempdir().unwrap();
        let version = tables.path().join("v1.0-mini");
        std::fs::create_dir(&version).unwrap();
        for (name, bytes) in files_below(&root.join("nuscenes_chain/v1.0-mini")) {
            std::fs::write(version.join(name), bytes).unwrap();
        }
        assert_eq!(same_frames(&from_folder, &open(roots([tables.path().into(), pictures.clone()]))), want);
    }
    // Sweeps are not in the tar: their absence shows when they are read, and names all roots.
    let sweeps = NuScenes::open(&chain(roots([meta, keys]), "scene-0655", FrameChoice::all_pictures())).unwrap();
    let view = sweeps.frame(1).unwrap().views.swap_remove(0);
    let error = view.image.unwrap().decode().unwrap_err();
    assert!(matches!(error, DataError::Missing { .. }) && error.to_string().contains("2 roots"), "{error}");
}

#[test]
fn packed_folders_give_the_same_frames() {
    let Some(root) = folder("RIGSCAPE_DATA", "nuscenes_chain") else { return };
    let keep = |name: &str| name.starts_with("v1.0-mini/") || name.contains("/CAM_");
    let files: Vec<_> = files_below(&root).into_iter().filter(|file| keep(&file.0)).collect();
    let dotted: Vec<_> = files.iter().map(|(name, bytes)| (format!("./top/{name}"), bytes.clone())).collect();
    let target = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: Vec<u8>| write(target.path(), name, &bytes);
    let inside = |path: PathBuf| Roots::new([Root { inside: "top".to_owned(), ..path.into() }]);
    let forms: [(&str, Roots); 5] = [
        ("stored zip", put("stored.zip", zip_bytes(&borrowed(&files), stored())).into()),
        ("deflated zip", put("deflated.zip", zip_bytes(&borrowed(&files), deflated())).into()),
        ("tar", put("plain.tar", tar_bytes(&borrowed(&files))).into()),
        ("zip with a top folder", inside(put("top.zip", zip_bytes(&borrowed(&dotted), deflated())))),
        ("tar with a top folder", inside(put("top.tar", tar_bytes(&borrowed(&dotted))))),
    ];
    for scene in ["scene-0916", "scene-0655"] {
        let open = |roots: Roots| NuScenes::open(&chain(roots, scene, FrameChoice::all_pictures())).unwrap();
        let from_folder = open(root.as_path().into());
        for (form, roots) in &forms {
            let pictures = same_frames(&from_folder, &open(roots.clone()));
            assert_eq!(pictures, if scene == "scene-0916" { 249 } else { 78 }, "{form}");
        }
    }
    let everything =
        NuScenesConfig { frames: FrameChoice::all_pictures(), ..NuScenesConfig::new(forms[2].1.clone(), "v1.0-mini") };
    let report = data::nuscenes::check(&everything, usize::MAX).unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    assert_eq!((report.pictures, report.decoded), (327, 327));
}

#[test]
fn sixteen_threads_read_one_archive_at_once() {
    let Some(root) = folder("RIGSCAPE_DATA", "nuscenes_chain") else { return };
    let files: Vec<_> = files_below(&root).into_iter().filter(|file| file.0.contains("/CAM_")).collect();
    let target = tempfile::tempdir().unwrap();
    for path in [
        write(target.path(), "a.zip", &zip_bytes(&borrowed(&files), stored())),
        write(target.path(), "b.zip", &zip_bytes(&borrowed(&files), deflated())),
        write(target.path(), "c.tar", &tar_bytes(&borrowed(&files))),
    ] {
        let store = Store::open(&path).unwrap();
        std::thread::scope(|scope| {
            for thread in 0..16 {
                let (store, files) = (&store, &files);
                scope.spawn(move || {
                    for at in 0..files.len() {
                        // Every thread walks in an order of its own.
                        let (name, bytes) = &files[(at * (2 * thread + 1) + 20 * thread) % files.len()];
                        let file = store.file(name, "picture").unwrap();
                        assert!(file.bytes().unwrap() == *bytes, "{file}");
                        let (head, tail) = file.ends(100).unwrap();
                        assert!(head == bytes[..100] && tail == bytes[bytes.len() - 2..]);
                    }
                });
            }
        });
    }
}

#[test]
fn a_compressed_tar_is_refused_until_it_is_converted() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let target = tempfile::tempdir().unwrap();
    for (name, inside, files, original) in [
        ("nuscenes_chain_tables.tgz", "v1.0-mini_root/v1.0-mini", 13, "nuscenes_chain/v1.0-mini"),
        ("occ3d_gts.tar.gz", "gts/scene-0655", 3, "nuscenes_chain/Occpancy3D-nuScenes-V1.0/mini/gts/scene-0655"),
    ] {
        let packed = root.join("archives").join(name);
        let error = Store::open(&packed).unwrap_err();
        assert!(matches!(error, DataError::Format { .. }), "{error:?}");
        assert!(error.to_string().contains("index_archive") && error.to_string().ends_with(name), "{error}");
        let tar = target.path().join(name).with_extension("tar");
        let error = index_archive(&packed, &tar, 1000).unwrap_err();
        assert!(error.to_string().contains("1000") && error.to_string().ends_with(name), "{error}");
        assert!(std::fs::read_dir(target.path()).unwrap().all(|entry| entry.unwrap().path() != tar));
        assert_eq!(index_archive(&packed, &tar, 1 << 30).unwrap(), files);
        assert!(matches!(index_archive(&packed, &tar, 1 << 30), Err(DataError::Config(_))), "never overwritten");
        let store = Store::open_all(&Roots::new([Root { inside: inside.to_owned(), ..tar.into() }])).unwrap();
        let found: Vec<_> = all_files(&store).into_iter().map(|(name, file)| (name, file.bytes().unwrap())).collect();
        assert_eq!(found.len(), files);
        assert!(found == files_below(&root.join(original)), "{name}");
    }
    let tables = Root { inside: "v1.0-mini_root".into(), ..target.path().join("nuscenes_chain_tables.tar").into() };
    let blobs = Root::from(root.join("archives/nuscenes_chain_blobs_stored.zip"));
    let open = |roots: Roots| NuScenes::open(&chain(roots, "scene-0655", FrameChoice::all_pictures())).unwrap();
    assert_eq!(same_frames(&open(root.join("nuscenes_chain").into()), &open(Roots::new([tables, blobs]))), 78);
    // Nothing but the converted archives was written, no half ones.
    assert_eq!(std::fs::read_dir(target.path()).unwrap().count(), 2);
}

#[test]
fn damaged_gzip_gives_no_tar() {
    let Some(root) = folder("RIGSCAPE_DATA", "archives/occ3d_gts.tar.gz") else { return };
    let whole = std::fs::read(root).unwrap();
    let target = tempfile::tempdir().unwrap();
    let tar = target.path().join("out.tar");
    let mut flipped = whole.clone();
    flipped[whole.len() / 2] ^= 4;
    for (name, bytes) in [("cut.tgz", &whole[..whole.len() / 2]), ("flipped.tgz", &flipped), ("text.tgz", b"text")] {
        let error = index_archive(&write(target.path(), name, bytes), &tar, 1 << 30).unwrap_err();
        assert!(error.to_string().ends_with(name), "{error}");
        assert_eq!(variant(&error), "Format");
        assert!(!tar.exists());
    }
    assert!(matches!(index_archive(Path::new("absent.tgz"), &tar, 1), Err(DataError::Missing { .. })));
}

#[test]
fn the_argoverse_log_lies_in_its_tar_as_in_its_folder() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let store = Store::open(root.join("archives/av2_log.tar")).unwrap();
    let folder = Store::open(root.join("argoverse2")).unwrap();
    let files = all_files(&store);
    assert_eq!(files.len(), 13);
    for (name, file) in files {
        assert!(file.on_disk().is_none());
        assert!(file.bytes().unwrap() == folder.read(&name, "file of the log").unwrap(), "{name}");
    }
}
