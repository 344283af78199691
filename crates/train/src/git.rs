//! The commit of the checked-out source, read from git's own files.

use std::fs;
use std::path::Path;

/// Commit of the repository that holds `start`, `None` outside of one.
#[must_use]
pub fn head_commit(start: &Path) -> Option<String> {
    let git = start.ancestors().map(|folder| folder.join(".git")).find(|git| git.is_dir())?;
    let head = fs::read_to_string(git.join("HEAD")).ok()?;
    let Some(name) = head.trim().strip_prefix("ref: ") else { return Some(head.trim().to_string()) };
    if let Ok(commit) = fs::read_to_string(git.join(name)) {
        return Some(commit.trim().to_string());
    }
    let packed = fs::read_to_string(git.join("packed-refs")).ok()?;
    packed.lines().find_map(|line| line.strip_suffix(name)).map(|commit| commit.trim().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_loose_packed_and_detached_heads() {
        let folder = tempfile::tempdir().unwrap();
        let git = folder.path().join(".git");
        fs::create_dir_all(git.join("refs/heads")).unwrap();
        fs::write(git.join("HEAD"), "ref: refs/heads/main\n").unwrap();
        let inside = folder.path().join("a");
        assert_eq!(head_commit(&inside), None);
        fs::write(git.join("packed-refs"), "# pack-refs\n1111 refs/heads/other\n2222 refs/heads/main\n").unwrap();
        assert_eq!(head_commit(&inside).as_deref(), Some("2222"));
        fs::write(git.join("refs/heads/main"), "3333\n").unwrap();
        assert_eq!(head_commit(&inside).as_deref(), Some("3333"));
        fs::write(git.join("HEAD"), "4444\n").unwrap();
        assert_eq!(head_commit(&inside).as_deref(), Some("4444"));
    }
}
