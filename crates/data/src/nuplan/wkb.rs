//! Geometry cells of a GeoPackage: a small header, then well-known binary.
//!
//! OGC GeoPackage 1.3, section 2.1.3; OGC Simple Feature Access part 1, section 8.2. Heights and measures are read over, points are left
//! out.

use geometry::glam::DVec2;

use crate::polygon::MapPolygon;

/// A cell's content.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Cell {
    /// The spatial reference system's number.
    pub srs: i32,
    /// Polylines, at least two points each.
    pub lines: Vec<Vec<DVec2>>,
    /// Polygons; rings do not repeat their first point and have at least three.
    pub polygons: Vec<MapPolygon>,
}

/// Geometries that hold others may be nested this deep.
const MAX_DEPTH: usize = 4;

/// Reads a cell.
///
/// # Errors
/// What is wrong with the bytes, as text.
pub fn parse(bytes: &[u8]) -> Result<Cell, String> {
    let mut reader = Reader { bytes, little: true };
    if reader.take(2)? != b"GP" {
        return Err("a geometry does not begin with GP".to_owned());
    }
    let [_version, flags] = reader.array()?;
    reader.little = flags & 1 == 1;
    let srs = reader.u32()? as i32;
    let envelope = match flags >> 1 & 7 {
        0 => 0,
        1 => 32,
        2 | 3 => 48,
        4 => 64,
        other => return Err(format!("a geometry has an envelope of unknown kind {other}")),
    };
    reader.take(envelope)?;
    let mut cell = Cell { srs, ..Cell::default() };
    reader.geometry(&mut cell, 0)?;
    match reader.bytes.len() {
        0 => Ok(cell),
        more => Err(format!("{more} bytes follow a geometry")),
    }
}

struct Reader<'b> {
    bytes: &'b [u8],
    little: bool,
}

impl<'b> Reader<'b> {
    fn take(&mut self, count: usize) -> Result<&'b [u8], String> {
        let (taken, rest) = self.bytes.split_at_checked(count).ok_or("a geometry ends early")?;
        self.bytes = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (taken, rest) = self.bytes.split_first_chunk::<N>().ok_or("a geometry ends early")?;
        self.bytes = rest;
        Ok(*taken)
    }

    fn u32(&mut self) -> Result<u32, String> {
        let bytes = self.array()?;
        Ok(if self.little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    fn f64(&mut self) -> Result<f64, String> {
        let bytes = self.array()?;
        Ok(if self.little { f64::from_le_bytes(bytes) } else { f64::from_be_bytes(bytes) })
    }

    fn geometry(&mut self, cell: &mut Cell, depth: usize) -> Result<(), String> {
        let [order] = self.array()?;
        self.little = match order {
            0 => false,
            1 => true,
            other => return Err(format!("a geometry has byte order {other}")),
        };
        let kind = self.u32()?;
        let numbers = match kind / 1000 {
            0 => 2,
            1 | 2 => 3,
            3 => 4,
            _ => return Err(format!("a geometry is of unknown kind {kind}")),
        };
        match kind % 1000 {
            1 => self.take(8 * numbers).map(drop),
            2 => {
                let line = self.points(numbers)?;
                cell.lines.extend((line.len() > 1).then_some(line));
                Ok(())
            }
            3 => self.polygon(cell, numbers),
            4..=7 if depth < MAX_DEPTH => {
                let little = self.little;
                for _ in 0..self.u32()? {
                    self.geometry(cell, depth + 1)?;
                    self.little = little;
                }
                Ok(())
            }
            4..=7 => Err(format!("geometries are nested more than {MAX_DEPTH} deep")),
            _ => Err(format!("a geometry is of unknown kind {kind}")),
        }
    }

    fn polygon(&mut self, cell: &mut Cell, numbers: usize) -> Result<(), String> {
        let mut rings = Vec::new();
        for _ in 0..self.u32()? {
            let mut ring = self.points(numbers)?;
            if ring.len() > 1 && ring.first() == ring.last() {
                ring.pop();
            }
            rings.push(ring);
        }
        let mut rings = rings.into_iter();
        let outer = rings.next().filter(|ring| ring.len() > 2);
        cell.polygons
            .extend(outer.map(|outer| MapPolygon { outer, holes: rings.filter(|ring| ring.len() > 2).collect() }));
        Ok(())
    }

    /// A count and as many points of this many numbers each.
    fn points(&mut self, numbers: usize) -> Result<Vec<DVec2>, String> {
        let count = self.u32()? as usize;
        if count > self.bytes.len() / (8 * numbers) {
            return Err(format!("a geometry ends early: {count} points are announced"));
        }
        let mut points = Vec::with_capacity(count);
        for _ in 0..count {
            let point = DVec2::new(self.f64()?, self.f64()?);
            self.take(8 * (numbers - 2))?;
            if !point.is_finite() {
                return Err("a coordinate is no number".to_owned());
            }
            points.push(point);
        }
        Ok(points)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(flags: u8, srs: i32, envelope: usize) -> Vec<u8> {
        let srs = if flags & 1 == 1 { srs.to_le_bytes() } else { srs.to_be_bytes() };
        [b"GP\0".as_slice(), &[flags], &srs, &vec![0; envelope]].concat()
    }

    fn floats(values: &[f64]) -> Vec<u8> {
        values.iter().flat_map(|value| value.to_le_bytes()).collect()
    }

    fn words(values: &[u32]) -> Vec<u8> {
        values.iter().flat_map(|value| value.to_le_bytes()).collect()
    }

    /// A little-endian geometry of this kind.
    fn body(kind: u32, counts: &[u32], numbers: &[f64]) -> Vec<u8> {
        [vec![1], words(&[kind]), words(counts), floats(numbers)].concat()
    }

    const SQUARE: [f64; 10] = [0.0, 0.0, 4.0, 0.0, 4.0, 4.0, 0.0, 4.0, 0.0, 0.0];

    #[test]
    fn lines_polygons_and_collections_are_read_with_any_envelope_and_extra_numbers() {
        for (indicator, envelope) in [(0, 0), (1, 32), (2, 48), (3, 48), (4, 64)] {
            let cell = [header(1 | indicator << 1, 4326, envelope), body(2, &[2], &[1.0, 2.0, 3.0, 4.0])].concat();
            let cell = parse(&cell).unwrap();
            assert_eq!((cell.srs, cell.lines), (4326, vec![vec![DVec2::new(1.0, 2.0), DVec2::new(3.0, 4.0)]]));
        }
        for kind in [1002, 2002] {
            let cell = [header(1, 1, 0), body(kind, &[2], &[1.0, 2.0, 9.0, 3.0, 4.0, 9.0])].concat();
            assert_eq!(parse(&cell).unwrap().lines[0][1], DVec2::new(3.0, 4.0));
        }
        let polygon = body(3, &[1, 5], &SQUARE);
        let several = [header(1, 1, 0), body(6, &[2], &[]), polygon.clone(), polygon].concat();
        let several = parse(&several).unwrap();
        assert_eq!((several.polygons.len(), several.polygons[0].outer.len()), (2, 4));
        let big =
            [header(0, 7, 0), vec![0, 0, 0, 0, 2, 0, 0, 0, 2], [1.0f64, 2.0, 3.0, 4.0].map(f64::to_be_bytes).concat()]
                .concat();
        let big = parse(&big).unwrap();
        assert_eq!((big.srs, big.lines[0][0]), (7, DVec2::new(1.0, 2.0)));
        let point = [header(1, 1, 0), body(1, &[], &[1.0, 2.0])].concat();
        assert_eq!(parse(&point).unwrap(), Cell { srs: 1, ..Cell::default() });
    }

    #[test]
    fn holes_stay_holes() {
        let hole: Vec<f64> = SQUARE.iter().map(|value| 1.0 + value / 2.0).collect();
        let bytes = [header(1, 1, 0), vec![1], words(&[3, 2, 5]), floats(&SQUARE), words(&[5]), floats(&hole)].concat();
        let found = parse(&bytes).unwrap().polygons;
        assert!(found[0].contains(DVec2::new(0.5, 0.5)) && !found[0].contains(DVec2::new(2.0, 2.0)));
    }

    #[test]
    fn every_cut_and_every_lie_is_refused() {
        let sound = [header(1, 1, 0), body(3, &[1, 5], &SQUARE)].concat();
        assert!((0..sound.len()).all(|length| parse(&sound[..length]).is_err()));
        let broken: [(Vec<u8>, &str); 8] = [
            ([sound.clone(), vec![0]].concat(), "1 bytes follow"),
            ([header(1, 1, 0), body(2, &[u32::MAX], &[])].concat(), "points are announced"),
            ([header(1, 1, 0), body(6, &[u32::MAX], &[])].concat(), "ends early"),
            ([header(1, 1, 0), body(2, &[2], &[1.0, f64::NAN, 3.0, 4.0])].concat(), "no number"),
            ([header(1, 1, 0), body(17, &[], &[])].concat(), "kind 17"),
            ([header(1, 1, 0), body(4002, &[], &[])].concat(), "kind 4002"),
            ([header(11, 1, 0), body(2, &[0], &[])].concat(), "envelope of unknown kind 5"),
            ([header(1, 1, 0), body(7, &[1], &[]).repeat(9)].concat(), "nested"),
        ];
        for (bytes, why) in broken {
            let error = parse(&bytes).unwrap_err();
            assert!(error.contains(why), "{error} instead of {why}");
        }
    }
}
