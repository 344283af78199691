//! The header of an .npy file: the text of a Python dictionary. Its three keys are parsed, nothing is evaluated.

/// Element types that are read. Files hold them in little-endian order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Dtype {
    Bool,
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F16,
    F32,
    F64,
}

impl Dtype {
    /// All that are read.
    pub const ALL: [Self; 12] = [
        Self::Bool,
        Self::U8,
        Self::I8,
        Self::U16,
        Self::I16,
        Self::U32,
        Self::I32,
        Self::U64,
        Self::I64,
        Self::F16,
        Self::F32,
        Self::F64,
    ];

    /// Bytes of one element.
    pub const fn size(self) -> usize {
        match self {
            Self::Bool | Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 | Self::F16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// Its text in a header.
    pub const fn descr(self) -> &'static str {
        match self {
            Self::Bool => "|b1",
            Self::U8 => "|u1",
            Self::I8 => "|i1",
            Self::U16 => "<u2",
            Self::I16 => "<i2",
            Self::U32 => "<u4",
            Self::I32 => "<i4",
            Self::U64 => "<u8",
            Self::I64 => "<i8",
            Self::F16 => "<f2",
            Self::F32 => "<f4",
            Self::F64 => "<f8",
        }
    }

    /// `None` for objects, texts, records, big-endian numbers and whatever else is not read.
    pub fn of_descr(descr: &str) -> Option<Self> {
        let known = |dtype: &Self| {
            descr == dtype.descr() || dtype.size() == 1 && descr.strip_prefix('<') == dtype.descr().strip_prefix('|')
        };
        Self::ALL.into_iter().find(known)
    }
}

/// What a header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    /// As written: not every element type is one that is read.
    pub descr: String,
    pub fortran_order: bool,
    pub shape: Vec<usize>,
}

/// More axes than any labels have.
const MOST_AXES: usize = 8;

impl Header {
    /// # Errors
    /// What is wrong with the text.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut text = Text { rest: text.trim() };
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        text.expect('{')?;
        while !text.take('}') {
            let key = text.string()?;
            text.expect(':')?;
            let is_new = match key {
                "descr" => descr.replace(text.string()?.to_owned()).is_none(),
                "fortran_order" => fortran_order.replace(text.truth()?).is_none(),
                "shape" => shape.replace(text.shape()?).is_none(),
                _ => return Err(format!("the header has a key {key:?}")),
            };
            if !is_new {
                return Err(format!("the header has {key:?} twice"));
            }
            if !text.take(',') {
                text.expect('}')?;
                break;
            }
        }
        if !text.rest.trim().is_empty() {
            return Err(format!("the header goes on after its dictionary: {}", text.glimpse()));
        }
        match (descr, fortran_order, shape) {
            (Some(descr), Some(fortran_order), Some(shape)) => Ok(Self { descr, fortran_order, shape }),
            _ => Err("the header lacks descr, fortran_order or shape".to_owned()),
        }
    }

    /// As a message names it: element type and shape.
    pub fn describe(&self) -> String {
        format!("{:?} {:?}", self.descr, self.shape)
    }

    /// Version 1.0, padded so that the data starts at a multiple of 64 bytes.
    pub fn write(dtype: Dtype, shape: &[usize]) -> Vec<u8> {
        let axes: String = shape.iter().map(|n| format!("{n}, ")).collect();
        let axes = if shape.len() > 1 { axes.trim_end_matches([' ', ',']) } else { axes.trim_end() };
        let mut text = format!("{{'descr': '{}', 'fortran_order': False, 'shape': ({axes}), }}", dtype.descr());
        let length = (10 + text.len() + 1).next_multiple_of(64);
        text.extend(std::iter::repeat_n(' ', length - 10 - text.len() - 1));
        text.push('\n');
        // Eight axes of twenty digits stay far below 65535.
        let length = (text.len() as u16).to_le_bytes();
        [b"\x93NUMPY\x01\x00".as_slice(), &length, text.as_bytes()].concat()
    }
}

/// A header that has been read up to some place.
struct Text<'a> {
    rest: &'a str,
}

impl<'a> Text<'a> {
    fn glimpse(&self) -> String {
        format!("{:?}", self.rest.chars().take(12).collect::<String>())
    }

    fn take(&mut self, sign: char) -> bool {
        match self.rest.trim_start().strip_prefix(sign) {
            Some(rest) => {
                self.rest = rest;
                true
            }
            None => false,
        }
    }

    fn expect(&mut self, sign: char) -> Result<(), String> {
        if self.take(sign) {
            return Ok(());
        }
        Err(format!("the header has {} where {sign:?} must stand", self.glimpse()))
    }

    fn string(&mut self) -> Result<&'a str, String> {
        let quote = if self.take('\'') {
            '\''
        } else {
            self.expect('"')?;
            '"'
        };
        let (string, rest) = self.rest.split_once(quote).ok_or("the header has an open string")?;
        self.rest = rest;
        Ok(string)
    }

    fn truth(&mut self) -> Result<bool, String> {
        for (word, value) in [("True", true), ("False", false)] {
            if let Some(rest) = self.rest.trim_start().strip_prefix(word) {
                self.rest = rest;
                return Ok(value);
            }
        }
        Err(format!("the header has {} where True or False must stand", self.glimpse()))
    }

    fn shape(&mut self) -> Result<Vec<usize>, String> {
        self.expect('(')?;
        let mut shape = Vec::new();
        while !self.take(')') {
            let start = self.rest.trim_start();
            let end = start.find(|sign: char| !sign.is_ascii_digit()).unwrap_or(start.len());
            let (digits, rest) = start.split_at(end);
            shape.push(digits.parse().map_err(|_| format!("the shape has {} as a length", self.glimpse()))?);
            self.rest = rest;
            if shape.len() > MOST_AXES {
                return Err(format!("more than {MOST_AXES} axes"));
            }
            if !self.take(',') {
                self.expect(')')?;
                break;
            }
        }
        Ok(shape)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_of_all_forms_are_read() {
        let header = |text: &str| Header::parse(text).unwrap();
        let usual = header("{'descr': '|u1', 'fortran_order': False, 'shape': (200, 200, 16), }           \n");
        assert_eq!(usual, Header { descr: "|u1".into(), fortran_order: false, shape: vec![200, 200, 16] });
        let other = header("{\"shape\":(3,),\"fortran_order\":True,\"descr\":\"<f8\"}");
        assert_eq!(other, Header { descr: "<f8".into(), fortran_order: true, shape: vec![3] });
        assert!(header("{'descr': '<i8', 'fortran_order': False, 'shape': ()}").shape.is_empty());
    }

    #[test]
    fn what_is_written_is_read_back() {
        for shape in [&[][..], &[5], &[200, 200, 16], &[usize::MAX; 8]] {
            for dtype in Dtype::ALL {
                let bytes = Header::write(dtype, shape);
                assert_eq!(bytes.len() % 64, 0);
                let header = Header::parse(std::str::from_utf8(&bytes[10..]).unwrap()).unwrap();
                assert_eq!((Dtype::of_descr(&header.descr), &*header.shape), (Some(dtype), shape));
            }
        }
    }

    #[test]
    fn expressions_and_other_texts_are_refused() {
        let bad = [
            "",
            "{}",
            "{'descr': '|u1'}",
            "{'descr': '|u1', 'fortran_order': False, 'shape': (2*3,)}",
            "{'descr': '|u1', 'fortran_order': False, 'shape': (-1,)}",
            "{'descr': '|u1', 'fortran_order': False, 'shape': (99999999999999999999,)}",
            "{'descr': '|u1', 'fortran_order': False, 'shape': [1]}",
            "{'descr': '|u1', 'fortran_order': 0, 'shape': (1,)}",
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}",
            "{'descr': __import__('os').system('true'), 'fortran_order': False, 'shape': (1,)}",
            "{'descr': '|u1', 'descr': '|u1', 'fortran_order': False, 'shape': (1,)}",
            "{'descr': '|u1', 'fortran_order': False, 'shape': (1,), 'x': 1}",
            "{'descr': '|u1', 'fortran_order': False, 'shape': (1,)} or 1",
            "{'descr': '|u1', 'fortran_order': False, 'shape': (1,1,1,1,1,1,1,1,1)}",
            "{'descr': '|u1",
        ];
        for text in bad {
            assert!(Header::parse(text).is_err(), "{text}");
        }
        for descr in ["|O", "<U32", ">f8", "|V8", "u1", "", "|u2", "<c8", "<M8[s]"] {
            assert_eq!(Dtype::of_descr(descr), None, "{descr}");
        }
        assert_eq!(Dtype::of_descr("<u1"), Some(Dtype::U8));
    }
}
