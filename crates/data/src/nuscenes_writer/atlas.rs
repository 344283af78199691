//! Where the scenes' worlds lie: beside each other on the map of a city whose traffic keeps to the same side.
//!
//! The map API knows four cities only, so right-hand worlds go to Boston and left-hand ones to Singapore.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec2;
use sha2::{Digest, Sha256};
use world::{MapAreaKind, TrafficSide, World};

use super::map_expansion::{MapBuilder, areas, shifted};
use super::prior::{self, Rings};
use super::tables::{MapRow, Tables};
use super::tokens::TokenSpace;
use crate::manifest::hex;
use crate::{DataError, staging};

/// Empty ground around every world, metres.
const MARGIN_M: f64 = 10.0;

/// The maps of all cities in use.
#[derive(Debug)]
pub(super) struct Atlas<'a> {
    tokens: &'a TokenSpace,
    /// Worlds in a row of a map.
    per_row: usize,
    sheets: Vec<Sheet<'a>>,
}

#[derive(Debug)]
struct Sheet<'a> {
    location: &'static str,
    builder: MapBuilder<'a>,
    drivable: Vec<Rings>,
    log_tokens: Vec<String>,
    next_corner: DVec2,
    row_height: f64,
    canvas: DVec2,
}

impl<'a> Atlas<'a> {
    pub(super) fn new(tokens: &'a TokenSpace, scenes: usize) -> Self {
        Self { tokens, per_row: (scenes as f64).sqrt().ceil() as usize, sheets: vec![] }
    }

    /// Finds room for a world and draws it there. Returns the city and `map_from_world`.
    pub(super) fn place(&mut self, world: &World, log_token: &str) -> (&'static str, DVec2) {
        let location = match world.conditions().traffic_side {
            TrafficSide::Right => "boston-seaport",
            TrafficSide::Left => "singapore-onenorth",
        };
        let index = match self.sheets.iter().position(|sheet| sheet.location == location) {
            Some(index) => index,
            None => {
                self.sheets.push(Sheet::new(location, self.tokens));
                self.sheets.len() - 1
            }
        };
        let shift = self.sheets[index].place(world, self.per_row);
        self.sheets[index].log_tokens.push(log_token.to_owned());
        (location, shift)
    }

    /// Writes priors and expansions, fills the map table and returns the files' SHA-256.
    pub(super) fn write(self, root: &Path, tables: &mut Tables) -> Result<BTreeMap<String, String>, DataError> {
        let mut digests = BTreeMap::new();
        staging::create_dir(&root.join("maps/expansion"))?;
        for sheet in self.sheets {
            let token = self.tokens.token("map", sheet.location);
            let png = format!("maps/{token}.png");
            prior::write(&root.join(&png), sheet.canvas, &sheet.drivable)?;
            let bytes = std::fs::read(root.join(&png)).map_err(staging::io("read", &root.join(&png)))?;
            digests.insert(png.clone(), hex(&Sha256::digest(&bytes)));
            let json = format!("maps/expansion/{}.json", sheet.location);
            let path = root.join(&json);
            let bytes = serde_json::to_vec(&sheet.builder.finish(sheet.canvas))
                .map_err(|e| DataError::Json { why: e.to_string(), path: path.clone() })?;
            staging::write(&path, &bytes)?;
            digests.insert(json, hex(&Sha256::digest(&bytes)));
            tables.map.push(MapRow { category: "semantic_prior", token, filename: png, log_tokens: sheet.log_tokens });
        }
        Ok(digests)
    }
}

impl<'a> Sheet<'a> {
    fn new(location: &'static str, tokens: &'a TokenSpace) -> Self {
        Self {
            location,
            builder: MapBuilder::new(tokens, location),
            drivable: vec![],
            log_tokens: vec![],
            next_corner: DVec2::splat(MARGIN_M),
            row_height: 0.0,
            canvas: DVec2::ZERO,
        }
    }

    fn place(&mut self, world: &World, per_row: usize) -> DVec2 {
        if !self.log_tokens.is_empty() && self.log_tokens.len().is_multiple_of(per_row) {
            self.next_corner = DVec2::new(MARGIN_M, self.next_corner.y + self.row_height + MARGIN_M);
            self.row_height = 0.0;
        }
        let map = world.map();
        let (low, high) = map.bounds();
        // Whole metres: positions keep their fractions, so the shift costs no digits that matter.
        let shift = (self.next_corner - low).ceil();
        let size = (high + shift - self.next_corner).ceil();
        self.next_corner.x += size.x + MARGIN_M;
        self.row_height = self.row_height.max(size.y);
        self.canvas = self.canvas.max(DVec2::new(self.next_corner.x, self.next_corner.y + size.y + MARGIN_M));
        self.builder.add(map, shift);
        let moved = shifted(map, shift);
        for kind in [MapAreaKind::DrivableArea, MapAreaKind::Walkway, MapAreaKind::Carpark] {
            self.drivable.extend(areas(&moved, kind));
        }
        shift
    }
}
