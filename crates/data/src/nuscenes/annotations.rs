//! Boxes as the tables hold them: in the world frame, at the samples' stamps, sorted by sample.

use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

use geometry::glam::{DQuat, DVec3};
use geometry::{GeometryError, Rigid};

use super::config::NuScenesConfig;
use super::json::{owned, read_all, read_table};
use super::rows::{AnnotationRow, AnnotationTable, AttributeTable, CategoryTable, InstanceTable, VisibilityTable};
use super::tables::Base;
use super::token::{Index, Key, Names, index_of, odd_text};
use crate::taxonomy::{self, ClassRule};
use crate::{DataError, ObjectClass};

/// One box.
#[derive(Debug, Clone, Copy)]
pub(super) struct Annotation {
    pub key: Key,
    pub sample: u32,
    pub instance: u32,
    pub center: DVec3,
    /// Length, width, height; the file holds width first.
    pub size: DVec3,
    pub rotation: DQuat,
    /// The same instance's annotations before and after, as rows; not always of neighbouring samples.
    pub before: Option<u32>,
    pub after: Option<u32>,
    /// Row in the attribute sets.
    pub attributes: u32,
    pub lidar_points: Option<u32>,
    pub radar_points: Option<u32>,
    pub visibility: Option<u8>,
}

/// A tracked object.
#[derive(Debug)]
pub(super) struct Instance {
    pub token: Box<str>,
    category: u32,
}

/// The boxes of the selected scenes.
#[derive(Debug)]
pub(super) struct Annotations {
    pub rows: Vec<Annotation>,
    /// Rows of each sample.
    pub by_sample: Vec<Range<usize>>,
    pub instances: Vec<Instance>,
    /// Native name and shared class; `None` for a class that is left out.
    categories: Vec<(Box<str>, Option<ObjectClass>)>,
    attribute_sets: Vec<Vec<String>>,
    names: Names,
}

impl Annotations {
    pub fn token(&self, row: &Annotation) -> String {
        self.names.text(row.key)
    }

    pub fn attributes(&self, row: &Annotation) -> &[String] {
        &self.attribute_sets[row.attributes as usize]
    }

    pub fn category(&self, row: &Annotation) -> (&str, Option<ObjectClass>) {
        let (name, class) = &self.categories[self.instances[row.instance as usize].category as usize];
        (name, *class)
    }
}

/// Indices that an annotation's keys are looked up in.
struct Lookup<'b> {
    base: &'b Base,
    instances: Index,
    attributes: Index,
    visibilities: Index,
    /// The level of each visibility row.
    levels: Vec<u8>,
}

/// An annotation before its attribute set has a number.
type Parsed = (Annotation, Vec<u32>, Option<Box<str>>);

/// `None` for tables without a single annotation, as those of the test split.
pub(super) fn read_annotations(config: &NuScenesConfig, base: &Base) -> Result<Option<Annotations>, DataError> {
    let file = base.file("category");
    let path = file.path().to_owned();
    let names = read_all::<CategoryTable, _, _>(&file, |row| Ok(Some((owned(&row.token), owned(&row.name)))))?;
    let category_index = index_of(names.iter().map(|row| &*row.0), "category", &path)?;
    let file = base.file("attribute");
    let path = file.path().to_owned();
    let attributes = read_all::<AttributeTable, _, _>(&file, |row| Ok(Some((owned(&row.token), owned(&row.name)))))?;
    let attribute_index = index_of(attributes.iter().map(|row| &*row.0), "attribute", &path)?;
    let file = base.file("visibility");
    let path = file.path().to_owned();
    let levels = read_all::<VisibilityTable, _, _>(&file, |row| Ok(Some(owned(&row.token))))?;
    let visibilities = index_of(levels.iter().map(|token| &**token), "visibility", &path)?;
    let file = base.file("instance");
    let path = file.path().to_owned();
    let instances = read_all::<InstanceTable, _, _>(&file, |row| {
        let category = category_index.get(Key::of(row.category_token.as_str())).ok_or_else(|| DataError::Dangling {
            table: "instance",
            token: row.token.as_str().to_owned(),
            field: "category_token",
            path: path.clone(),
        })?;
        Ok(Some(Instance { token: owned(&row.token), category }))
    })?;
    let lookup = Lookup {
        base,
        instances: index_of(instances.iter().map(|row| &*row.token), "instance", &path)?,
        attributes: attribute_index,
        visibilities,
        // The release's tokens are the levels themselves; other tables list the levels in ascending order.
        levels: levels.iter().zip(1u8..).map(|(token, row)| token.parse().unwrap_or(row)).collect(),
    };
    let categories = names.into_iter().map(|(_, name)| (name, None)).collect();
    let mut found = Annotations {
        rows: Vec::new(),
        by_sample: Vec::new(),
        instances,
        categories,
        attribute_sets: Vec::new(),
        names: Names::default(),
    };
    let attributes: Vec<String> = attributes.into_iter().map(|row| row.1.into()).collect();
    if !found.read_rows(&lookup, &attributes)? {
        return Ok(None);
    }
    found.resolve_classes(config)?;
    found.link(base);
    Ok(Some(found))
}

impl Annotations {
    /// False when the table has no row at all.
    fn read_rows(&mut self, lookup: &Lookup<'_>, attributes: &[String]) -> Result<bool, DataError> {
        let file = lookup.base.file("sample_annotation");
        let path = file.path().to_owned();
        let any = std::sync::atomic::AtomicBool::new(false);
        let mut sets: HashMap<Vec<u32>, u32> = HashMap::new();
        read_table::<AnnotationTable, _, _, _>(
            &file,
            |row| {
                any.store(true, std::sync::atomic::Ordering::Relaxed);
                lookup.parse(&row, &path)
            },
            |part| {
                for (mut row, set, odd) in part {
                    row.attributes = *sets.entry(set).or_insert_with_key(|set| {
                        let names = set.iter().map(|row| attributes[*row as usize].clone()).collect();
                        self.attribute_sets.push(names);
                        self.attribute_sets.len() as u32 - 1
                    });
                    self.names.insert(row.key, odd);
                    self.rows.push(row);
                }
                Ok(())
            },
        )?;
        Index::new(self.rows.iter().map(|row| row.key)).map_err(|row| DataError::DuplicateToken {
            table: "sample_annotation",
            token: self.names.text(self.rows[row].key),
            path: path.clone(),
        })?;
        Ok(any.into_inner())
    }

    /// Only categories that occur need a rule: other tables of this schema list categories that never carry a box.
    fn resolve_classes(&mut self, config: &NuScenesConfig) -> Result<(), DataError> {
        let mut occurs = vec![false; self.categories.len()];
        for row in &self.rows {
            occurs[self.instances[row.instance as usize].category as usize] = true;
        }
        for ((name, class), _) in self.categories.iter_mut().zip(occurs).filter(|(_, occurs)| *occurs) {
            *class =
                match config.classes.get(&**name) {
                    Some(ClassRule::Drop) => None,
                    Some(ClassRule::As(class)) => Some(*class),
                    None => Some(taxonomy::from_nuscenes(name).ok_or_else(|| DataError::UnknownClass {
                        dataset: config.name.clone(),
                        name: name.to_string(),
                    })?),
                };
        }
        Ok(())
    }

    /// Sorts by sample (the file's order within one) and links each instance's rows in time.
    fn link(&mut self, base: &Base) {
        self.rows.sort_by_key(|row| row.sample);
        let mut start = 0;
        for sample in 0..base.samples.len() {
            let count = self.rows[start..].iter().take_while(|row| row.sample as usize == sample).count();
            self.by_sample.push(start..start + count);
            start += count;
        }
        // Samples are ordered by scene and time and an instance lives in one scene, so row order is time order.
        let mut latest: Vec<Option<u32>> = vec![None; self.instances.len()];
        for row in 0..self.rows.len() {
            let instance = self.rows[row].instance as usize;
            let before = latest[instance].replace(row as u32);
            let same_scene = |other: &u32| {
                let scene = |row: usize| base.samples[self.rows[row].sample as usize].scene;
                scene(*other as usize) == scene(row)
            };
            let before = before.filter(same_scene);
            self.rows[row].before = before;
            if let Some(before) = before {
                self.rows[before as usize].after = Some(row as u32);
            }
        }
    }
}

impl Lookup<'_> {
    fn parse(&self, row: &AnnotationRow<'_>, path: &Path) -> Result<Option<Parsed>, DataError> {
        let token = row.token.as_str();
        let dangling = |field| DataError::Dangling {
            table: "sample_annotation",
            token: token.to_owned(),
            field,
            path: path.to_owned(),
        };
        let sample = self.base.sample(row.sample_token.as_str()).map_err(|()| dangling("sample_token"))?;
        let Some(sample) = sample else { return Ok(None) };
        let instance = self.instances.get(Key::of(row.instance_token.as_str()));
        let instance = instance.ok_or_else(|| dangling("instance_token"))?;
        let attributes = row.attribute_tokens.iter().map(|token| self.attributes.get(Key::of(token.as_str())));
        let attributes: Option<Vec<u32>> = attributes.collect();
        let attributes = attributes.ok_or_else(|| dangling("attribute_tokens"))?;
        let visibility = match row.visibility_token.as_str() {
            "" => None,
            text => {
                let level = self.visibilities.get(Key::of(text)).ok_or_else(|| dangling("visibility_token"))?;
                Some(self.levels[level as usize])
            }
        };
        let pose = check_box(row).map_err(|source| DataError::Annotation {
            token: token.to_owned(),
            why: source.to_string(),
            path: path.to_owned(),
        })?;
        let [width, length, height] = row.size;
        let annotation = Annotation {
            key: Key::of(token),
            sample,
            instance,
            center: pose.translation,
            size: DVec3::new(length, width, height),
            rotation: pose.rotation,
            before: None,
            after: None,
            attributes: 0,
            lidar_points: u32::try_from(row.num_lidar_pts).ok(),
            radar_points: u32::try_from(row.num_radar_pts).ok(),
            visibility,
        };
        Ok(Some((annotation, attributes, odd_text(token))))
    }
}

fn check_box(row: &AnnotationRow<'_>) -> Result<Rigid, GeometryError> {
    for (what, value) in ["box width", "box length", "box height"].into_iter().zip(row.size) {
        if !value.is_finite() {
            return Err(GeometryError::NotFinite { what });
        }
        if value <= 0.0 {
            return Err(GeometryError::NotPositive { what, value });
        }
    }
    Rigid::from_wxyz(row.rotation, row.translation)
}
