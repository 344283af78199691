//! Every shipped experiment file is read strictly, and the small ones say what they promise.

use std::path::{Path, PathBuf};

use rigscape::bev_vae::Experiment;
use rigscape::config_file;

fn files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else {
            found.push(path);
        }
    }
}

#[test]
fn shipped_configs_are_read_strictly_and_stay_short() {
    let mut found = Vec::new();
    files(&Path::new(env!("CARGO_MANIFEST_DIR")).join("configs"), &mut found);
    assert!(found.len() >= 3, "{found:?}");
    for path in found {
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.starts_with('#'), "{}: open with what to expect", path.display());
        assert!(
            text.lines().filter(|line| !line.trim().is_empty()).count() <= 50,
            "{}: differences only",
            path.display()
        );
        let experiment: Experiment = config_file::load(&path, &[]).unwrap_or_else(|error| panic!("{error:#}"));
        // What a run writes into its folder must read back as the same experiment.
        let again: Experiment = config_file::parse(&toml::to_string(&experiment).unwrap(), &[]).unwrap();
        assert_eq!(experiment, again, "{}", path.display());
    }
}
