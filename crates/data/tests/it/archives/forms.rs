//! Every form of header that writers use, made here.

use std::io::Read;
use std::path::Path;

use data::DataError;
use data::store::{Root, Roots, Store};

use super::{all_files, deflated, roots, stored, tar_bytes, write, zip_bytes};

fn contents(path: &Path) -> Vec<(String, Vec<u8>)> {
    let store = Store::open(path).unwrap();
    all_files(&store).into_iter().map(|(name, file)| (name, file.bytes().unwrap())).collect()
}

#[test]
fn zip64_headers_and_local_extra_fields_are_followed() {
    let folder = tempfile::tempdir().unwrap();
    // A zip64 field in the local header and none in the directory: their lengths differ.
    let files: [(&str, &[u8]); 3] = [("a", b"first"), ("b/c", b"second"), ("b/d", b"")];
    for (name, options) in [
        ("large.zip", stored().large_file(true)),
        ("large_deflated.zip", deflated().large_file(true)),
        ("aligned.zip", stored().with_alignment(512)),
    ] {
        let path = write(folder.path(), name, &zip_bytes(&files, options));
        let want: Vec<_> = files.map(|(name, bytes)| (name.to_owned(), bytes.to_vec())).into();
        assert_eq!(contents(&path), want, "{name}");
    }
    // More entries than the old end record counts.
    let names: Vec<String> = (0..66_000).map(|i| format!("f/{i:05}")).collect();
    let files: Vec<(&str, &[u8])> = names.iter().map(|name| (name.as_str(), name.as_bytes())).collect();
    let store = Store::open(write(folder.path(), "many.zip", &zip_bytes(&files, stored()))).unwrap();
    assert_eq!(store.list("f").unwrap().len(), 66_000);
    assert_eq!(store.read("f/65999", "file").unwrap(), b"f/65999");
}

#[test]
fn a_comment_that_looks_like_an_end_record_is_a_comment() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = zip_bytes(&[("a", b"text")], stored());
    let comment = b"PK\x05\x06 and more than twenty-two bytes";
    let at = bytes.len() - 2;
    bytes[at..].copy_from_slice(&(comment.len() as u16).to_le_bytes());
    bytes.extend(comment);
    assert_eq!(contents(&write(folder.path(), "comment.zip", &bytes)), [("a".to_owned(), b"text".to_vec())]);
}

#[test]
fn folders_in_archives_need_no_entry_and_may_have_one() {
    let folder = tempfile::tempdir().unwrap();
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    zip.add_directory("./a/", stored()).unwrap();
    zip.start_file("a/b", stored()).unwrap();
    let zip = write(folder.path(), "a.zip", &zip.finish().unwrap().into_inner());
    let mut tar = tar::Builder::new(Vec::new());
    let mut header = tar::Header::new_ustar();
    header.set_entry_type(tar::EntryType::Directory);
    header.set_size(0);
    tar.append_data(&mut header, "./", &[][..]).unwrap();
    header.set_entry_type(tar::EntryType::Regular);
    tar.append_data(&mut header, "a/b", &[][..]).unwrap();
    let tar = write(folder.path(), "a.tar", &tar.into_inner().unwrap());
    for path in [zip, tar] {
        assert_eq!(contents(&path), [("a/b".to_owned(), Vec::new())]);
        let store = Store::open(&path).unwrap();
        assert!(store.find("a").is_none() && store.find("./a//b").is_some() && store.find("a/../a/b").is_none());
    }
}

#[test]
fn tar_names_and_sizes_of_every_kind_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let long = "l".repeat(90) + "/" + &"m".repeat(90) + "/" + &"n".repeat(150);
    let mut builder = tar::Builder::new(Vec::new());
    let mut header = tar::Header::new_gnu();
    header.set_size(4);
    builder.append_data(&mut header, &long, &b"long"[..]).unwrap();
    // ustar splits a name of up to 255 bytes into prefix and name.
    let mut header = tar::Header::new_ustar();
    header.set_size(6);
    header.set_path("p".repeat(120) + "/" + &"q".repeat(90)).unwrap();
    header.set_cksum();
    builder.append(&header, &b"prefix"[..]).unwrap();
    // A pax header holds the name and the size of what follows; the size in the plain header is wrong.
    builder.append_pax_extensions([("path", "pax/\u{fc}".as_bytes()), ("size", b"5")]).unwrap();
    let mut header = tar::Header::new_ustar();
    header.set_size(0);
    header.set_path("short").unwrap();
    header.set_cksum();
    builder.append(&header, &b""[..]).unwrap();
    let mut bytes = builder.into_inner().unwrap();
    bytes.truncate(bytes.len() - 1024);
    bytes.extend(b"by pa");
    bytes.resize(bytes.len().next_multiple_of(512), 0);
    // The size in base 256.
    let mut header = tar::Header::new_gnu();
    header.set_path("binary").unwrap();
    header.as_old_mut().size = [0x80, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 3];
    header.set_cksum();
    bytes.extend(header.as_bytes());
    bytes.extend(b"256");
    bytes.resize(bytes.len().next_multiple_of(512) + 1024, 0);
    let want = [
        ("binary".to_owned(), b"256".to_vec()),
        (long, b"long".to_vec()),
        ("pax/\u{fc}".to_owned(), b"by pa".to_vec()),
        ("p".repeat(120) + "/" + &"q".repeat(90), b"prefix".to_vec()),
    ];
    assert_eq!(contents(&write(folder.path(), "a.tar", &bytes)), want);
}

#[test]
fn earlier_roots_win_and_lists_are_joined() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::create_dir_all(path.join("dir/x")).unwrap();
    std::fs::write(path.join("dir/x/both"), "folder").unwrap();
    std::fs::write(path.join("dir/x/disk"), "disk").unwrap();
    let zip = write(path, "a.zip", &zip_bytes(&[("x/both", b"zip"), ("x/packed", b"packed"), ("y/z", b"")], stored()));
    let tar = write(path, "a.tar", &tar_bytes(&[("x/both", b"tar"), ("x/last", b"last")]));
    let read = |order: [&Path; 3]| {
        let store = Store::open_all(&roots(order.map(Path::to_owned))).unwrap();
        let names: Vec<String> = store.list("x").unwrap().into_iter().map(|name| name.name).collect();
        assert_eq!(names, ["both", "disk", "last", "packed"]);
        assert_eq!(store.read("x/last", "file").unwrap(), b"last");
        assert_eq!(store.expected("x/packed").bytes().unwrap(), b"packed");
        let absent = store.expected("x/none");
        assert!(absent.bytes().is_err() && absent.reader().is_err() && absent.ends(1).is_err());
        let error = store.file("x/none", "thing").unwrap_err().to_string();
        assert!(error.starts_with("missing thing") && error.contains("3 roots"), "{error}");
        store.read("x/both", "file").unwrap()
    };
    let dir = path.join("dir");
    assert_eq!(read([&dir, &zip, &tar]), b"folder");
    assert_eq!(read([&zip, &tar, &dir]), b"zip");
    assert_eq!(read([&tar, &dir, &zip]), b"tar");
    for (inside, at) in [("x", &zip), ("./x/", &tar), ("x", &dir)] {
        let root = Root { inside: inside.to_owned(), ..at.clone().into() };
        assert!(Store::open_all(&Roots::new([root])).unwrap().find("both").is_some(), "{}", at.display());
    }
    for inside in ["nothing", "x/both", "xx"] {
        let root = Root { inside: inside.to_owned(), ..zip.clone().into() };
        assert!(matches!(Store::open_all(&Roots::new([root])), Err(DataError::Missing { .. })), "{inside}");
    }
    let root = Root { inside: "../dir".to_owned(), ..dir.into() };
    assert!(matches!(Store::open_all(&Roots::new([root])), Err(DataError::UnsafePath { .. })));
    assert!(matches!(Store::open_all(&Roots::new([])), Err(DataError::Config(_))));
}

#[test]
fn streams_equal_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let text: Vec<u8> = (0..200_000u32).flat_map(|i| (i % 777).to_le_bytes()).collect();
    let files: [(&str, &[u8]); 2] = [("t", &text), ("e", b"")];
    for path in [
        write(folder.path(), "a.zip", &zip_bytes(&files, stored())),
        write(folder.path(), "b.zip", &zip_bytes(&files, deflated())),
        write(folder.path(), "c.tar", &tar_bytes(&files)),
    ] {
        let store = Store::open(&path).unwrap();
        for (name, want) in files {
            let mut got = Vec::new();
            store.file(name, "file").unwrap().reader().unwrap().read_to_end(&mut got).unwrap();
            assert!(got == want, "{name} of {}", path.display());
            let (head, tail) = store.file(name, "file").unwrap().ends(10).unwrap();
            assert_eq!(head, want[..want.len().min(10)]);
            assert_eq!(tail, want.last_chunk().copied().unwrap_or_default());
        }
    }
}

#[test]
fn a_kept_index_is_used_only_for_its_archive_and_only_when_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let cache = folder.path().join("index/cache");
    let path = write(folder.path(), "a.zip", &zip_bytes(&[("a", b"1"), ("b", b"2")], deflated()));
    let open = |index_cache: Option<&Path>| {
        let index_cache = index_cache.map(Path::to_owned);
        Store::open_all(&Roots::new([Root { index_cache, ..path.clone().into() }])).unwrap()
    };
    let names = |store: &Store| store.list("").unwrap().into_iter().map(|name| name.name).collect::<Vec<_>>();
    let kept = || std::fs::read_dir(&cache).unwrap().map(|entry| entry.unwrap().path()).collect::<Vec<_>>();
    open(None);
    assert!(!cache.exists());
    assert_eq!(names(&open(Some(&cache))), ["a", "b"]);
    let [file] = kept().try_into().unwrap();
    let first = std::fs::read(&file).unwrap();
    assert_eq!(open(Some(&cache)).read("b", "file").unwrap(), b"2");
    // An index that says something else is believed: it is used.
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&first[64..]).unwrap();
    let other = serde_json::to_vec(&rows[..1]).unwrap();
    let digest = <sha2::Sha256 as sha2::Digest>::digest(&other);
    let sum: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    std::fs::write(&file, [sum.as_bytes(), &other].concat()).unwrap();
    assert_eq!(names(&open(Some(&cache))), ["a"]);
    // A damaged one is made anew.
    for damaged in [&first[..first.len() - 3], &first[..10], b""] {
        std::fs::write(&file, damaged).unwrap();
        assert_eq!(names(&open(Some(&cache))), ["a", "b"]);
        assert_eq!(std::fs::read(&file).unwrap(), first);
    }
    // Another archive in its place has another key.
    write(folder.path(), "a.zip", &zip_bytes(&[("c", b"1"), ("d", b"2")], deflated()));
    assert_eq!(names(&open(Some(&cache))), ["c", "d"]);
    assert_eq!(kept().len(), 2);
}
