//! The table of weight files against the files that are there.

use features::{KNOWN_WEIGHTS, known_weights, require};

use crate::golden;

#[test]
fn the_table_agrees_with_the_shipped_files() {
    for known in KNOWN_WEIGHTS {
        assert_eq!(KNOWN_WEIGHTS.iter().filter(|other| other.file == known.file).count(), 1, "{} twice", known.file);
        let digits = known.sha256.unwrap_or("0");
        assert!(digits.len() <= 64 && digits.bytes().all(|digit| digit.is_ascii_hexdigit()), "{}", known.file);
        if let Some(stand_in) = known.stand_in {
            assert!(known_weights(stand_in.file).is_some(), "{} has no row", stand_in.file);
        }
    }
    let Some(weights) = golden::weights() else { return };
    let sums = std::fs::read_to_string(weights.join("SHA256SUMS")).unwrap();
    let mut checked = 0;
    for (sum, file) in sums.lines().filter_map(|line| line.split_once("  ")) {
        let Some(known) = known_weights(file) else { continue };
        assert_eq!(known.matches(sum), Some(true), "{file}");
        assert_eq!(known.matches(&"0".repeat(64)), Some(false), "{file}");
        assert_eq!(known.bytes, Some(std::fs::metadata(weights.join(file)).unwrap().len()), "{file}");
        checked += 1;
    }
    assert_eq!(checked, KNOWN_WEIGHTS.iter().filter(|known| known.bytes.is_some()).count());
}

#[test]
fn a_missing_file_says_where_it_comes_from_and_what_else_there_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pt_inception-2015-12-05-6726825d.pth");
    let text = require(&path).unwrap_err().to_string();
    assert!(text.contains("pytorch-fid") && text.contains(&path.display().to_string()), "{text}");
    assert!(text.contains("then the number is called fid-efficientnet-lite0"), "{text}");
    let unknown = require(&folder.path().join("mine.pth")).unwrap_err();
    assert!(unknown.known.is_none() && unknown.to_string().ends_with("mine.pth"));
    std::fs::write(&path, "").unwrap();
    assert_eq!(require(&path).unwrap(), path);
}
