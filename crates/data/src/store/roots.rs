//! Where a dataset lies: one folder or archive, or several that together make it up.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// A folder or an archive (zip, uncompressed tar).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "RootForm", into = "RootForm")]
pub struct Root {
    /// The folder or archive.
    pub path: PathBuf,
    /// Folder inside it that is taken for the root, `/` between parts; empty for all of it.
    pub inside: String,
    /// Folder that keeps the archive's table of contents between runs; worth it for archives of a million entries.
    pub index_cache: Option<PathBuf>,
}

/// The roots of a dataset: a name is looked for in all of them, the first that has it wins.
///
/// In a config file either one root or a list. A root is a path, or a table:
///
/// ```toml
/// root = ["/data/nuscenes", "/data/v1.0-trainval01_blobs.tar", { path = "/data/meta.tar", inside = "v1.0_root" }]
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "RootsForm", into = "RootsForm")]
pub struct Roots(Vec<Root>);

impl Roots {
    /// In the order in which they are searched.
    pub fn new(roots: impl IntoIterator<Item = Root>) -> Self {
        Self(roots.into_iter().collect())
    }

    /// In the order in which they are searched.
    pub fn as_slice(&self) -> &[Root] {
        &self.0
    }

    /// All paths, for messages.
    pub fn display(&self) -> impl fmt::Display + '_ {
        fmt::from_fn(|f| {
            for (at, root) in self.0.iter().enumerate() {
                write!(f, "{}{}", if at == 0 { "" } else { ", " }, root.path.display())?;
            }
            Ok(())
        })
    }
}

impl From<PathBuf> for Root {
    fn from(path: PathBuf) -> Self {
        Self { path, inside: String::new(), index_cache: None }
    }
}

impl<P: Into<PathBuf>> From<P> for Roots {
    fn from(path: P) -> Self {
        Self(vec![Root::from(path.into())])
    }
}

/// How a root stands in a file.
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "a root is a path, or a table with `path` and perhaps `inside` and `index_cache`")]
enum RootForm {
    Path(PathBuf),
    Table(RootTable),
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RootTable {
    path: PathBuf,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    inside: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    index_cache: Option<PathBuf>,
}

impl From<RootForm> for Root {
    fn from(form: RootForm) -> Self {
        match form {
            RootForm::Path(path) => path.into(),
            RootForm::Table(RootTable { path, inside, index_cache }) => Self { path, inside, index_cache },
        }
    }
}

impl From<Root> for RootForm {
    fn from(root: Root) -> Self {
        let Root { path, inside, index_cache } = root;
        if inside.is_empty() && index_cache.is_none() {
            return Self::Path(path);
        }
        Self::Table(RootTable { path, inside, index_cache })
    }
}

/// How roots stand in a file.
#[derive(Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "`root` is a path, a table with `path` and perhaps `inside` and `index_cache`, or a list of these"
)]
enum RootsForm {
    Many(Vec<Root>),
    One(Root),
}

impl From<RootsForm> for Roots {
    fn from(form: RootsForm) -> Self {
        match form {
            RootsForm::One(root) => Self(vec![root]),
            RootsForm::Many(roots) => Self(roots),
        }
    }
}

impl From<Roots> for RootsForm {
    fn from(roots: Roots) -> Self {
        match <[Root; 1]>::try_from(roots.0) {
            Ok([root]) => Self::One(root),
            Err(roots) => Self::Many(roots),
        }
    }
}

impl Root {
    /// The folder that `inside` names, for messages.
    pub(super) fn shown(&self) -> PathBuf {
        if self.inside.is_empty() { self.path.clone() } else { self.path.join(Path::new(&self.inside)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Config {
        root: Roots,
    }

    #[test]
    fn one_path_a_list_and_tables_are_read_and_written() {
        let parse = |text: &str| toml::from_str::<Config>(text);
        let one = parse("root = \"a\"").unwrap();
        assert_eq!(one.root, Roots::from("a"));
        assert_eq!(toml::to_string(&one).unwrap(), "root = \"a\"\n");
        let several = parse(r#"root = ["a", { path = "b.zip", inside = "top", index_cache = "c" }]"#).unwrap();
        let [first, second] = several.root.as_slice() else { panic!("{several:?}") };
        assert_eq!((first, &*second.inside), (&Root::from(PathBuf::from("a")), "top"));
        assert_eq!(second.index_cache.as_deref(), Some(Path::new("c")));
        assert_eq!(several.root.display().to_string(), "a, b.zip");
        for config in [one, several, parse("root = { path = \"a.tar\", inside = \"b\" }").unwrap()] {
            assert_eq!(parse(&toml::to_string(&config).unwrap()).unwrap(), config);
            assert_eq!(serde_json::from_value::<Config>(serde_json::to_value(&config).unwrap()).unwrap(), config);
        }
        for refused in ["root = 3", "root = { path = \"a\", insid = \"b\" }", "root = [\"a\", { inside = \"b\" }]"] {
            let error = parse(refused).unwrap_err().to_string();
            assert!(error.contains("`path`"), "{error}");
        }
    }
}
