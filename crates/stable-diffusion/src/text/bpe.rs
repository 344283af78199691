//! Byte pairs: the table of merges, from bytes to token ids and back.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use flate2::read::GzDecoder;

use super::TextError;

/// Marks the last symbol of a piece.
const WORD_END: &str = "</w>";

/// Token before every text.
const BEGIN: &str = "<|startoftext|>";

/// Token behind every text.
const END: &str = "<|endoftext|>";

/// Merges that CLIP uses of its table; the rest of the table is left over from a larger vocabulary.
const CLIP_MERGES: usize = 49_152 - 256 - 2;

/// No table of merges is longer.
const MAX_TABLE_BYTES: u64 = 64 << 20;

/// A vocabulary of bytes and merged bytes.
#[derive(Debug, Clone)]
pub struct BytePairs {
    /// Text of each id, in the alphabet of [`byte_symbols`].
    symbols: Vec<String>,
    /// Ids of bytes inside a piece and at its end.
    bytes: [Vec<u32>; 2],
    /// In order of rank.
    merges: Vec<[u32; 2]>,
    /// Rank and result.
    by_pair: HashMap<[u32; 2], (usize, u32)>,
    begin: u32,
    end: u32,
}

impl BytePairs {
    /// From `vocab.json` (text to id) and `merges.txt` (a pair per line, best first).
    ///
    /// # Errors
    /// [`TextError`] for unreadable files, ids with gaps, missing bytes, merges whose parts or result are no tokens.
    pub fn from_folder(folder: &Path) -> Result<Self, TextError> {
        let path = folder.join("vocab.json");
        let refuse = |reason: String| TextError::Format { reason, path: path.clone() };
        let vocabulary: HashMap<String, u32> =
            serde_json::from_str(&read_text(&path)?).map_err(|error| refuse(error.to_string()))?;
        let mut symbols = vec![None; vocabulary.len()];
        for (symbol, id) in vocabulary {
            match symbols.get_mut(id as usize) {
                Some(slot @ None) => *slot = Some(symbol),
                _ => return Err(refuse(format!("id {id} of {symbol:?} is taken or leaves a gap"))),
            }
        }
        let symbols: Vec<String> = symbols.into_iter().flatten().collect();
        let path = folder.join("merges.txt");
        let text = read_text(&path)?;
        // Only the first line may be a comment: "#" is a symbol like others.
        let header = usize::from(text.starts_with("#version"));
        let lines: Vec<(usize, &str)> = numbered(&text).skip(header).collect();
        Self::new(symbols, &lines, &path)
    }

    /// From the table that CLIP was released with, `bpe_simple_vocab_16e6.txt`, as it is or with gzip.
    ///
    /// # Errors
    /// [`TextError`] for an unreadable file or a table without the merges.
    pub fn from_table(path: &Path) -> Result<Self, TextError> {
        let text = read_text(path)?;
        let lines: Vec<(usize, &str)> = numbered(&text).skip(1).take(CLIP_MERGES).collect();
        if lines.len() < CLIP_MERGES {
            let reason = format!("{} merges, CLIP has {CLIP_MERGES}", lines.len());
            return Err(TextError::Format { reason, path: path.to_path_buf() });
        }
        let inside: Vec<String> = bytes_in_order().into_iter().map(|(_, symbol)| symbol.to_string()).collect();
        let at_end = inside.iter().map(|symbol| format!("{symbol}{WORD_END}"));
        let merged = lines.iter().map(|(_, line)| line.replace(' ', ""));
        let marks = [BEGIN, END].map(str::to_owned);
        let symbols = inside.iter().cloned().chain(at_end).chain(merged).chain(marks).collect();
        Self::new(symbols, &lines, path)
    }

    fn new(symbols: Vec<String>, lines: &[(usize, &str)], path: &Path) -> Result<Self, TextError> {
        let refuse = |reason: String| TextError::Format { reason, path: path.to_path_buf() };
        let ids: HashMap<&str, u32> = symbols.iter().zip(0..).map(|(symbol, id)| (symbol.as_str(), id)).collect();
        let id = |symbol: &str| ids.get(symbol).copied();
        let known = |symbol: &str| id(symbol).ok_or_else(|| refuse(format!("{symbol:?} is no token")));
        let byte_symbols = byte_symbols();
        let all = |ending: &str| -> Result<Vec<u32>, TextError> {
            byte_symbols.iter().map(|symbol| known(&format!("{symbol}{ending}"))).collect()
        };
        let bytes = [all("")?, all(WORD_END)?];
        let (begin, end) = (known(BEGIN)?, known(END)?);
        let mut merges = Vec::with_capacity(lines.len());
        let mut by_pair = HashMap::with_capacity(lines.len());
        for (rank, (line, text)) in lines.iter().enumerate() {
            let wrong = |reason: String| TextError::Line { line: *line, reason, path: path.to_path_buf() };
            let pair = text.split_once(' ').filter(|(_, right)| !right.contains(' '));
            let (left, right) = pair.ok_or_else(|| wrong(format!("{text:?} is no pair")))?;
            let token = |symbol: &str| id(symbol).ok_or_else(|| wrong(format!("{symbol:?} is no token")));
            let pair = [token(left)?, token(right)?];
            if by_pair.insert(pair, (rank, token(&format!("{left}{right}"))?)).is_some() {
                return Err(wrong(format!("{text:?} stands here a second time")));
            }
            merges.push(pair);
        }
        Ok(Self { bytes, merges, by_pair, begin, end, symbols })
    }

    /// Number of tokens.
    #[must_use]
    pub fn vocabulary_size(&self) -> usize {
        self.symbols.len()
    }

    /// Ids of the begin and the end token.
    #[must_use]
    pub fn marks(&self) -> [u32; 2] {
        [self.begin, self.end]
    }

    /// Id of a token by its text.
    pub(super) fn id(&self, symbol: &str) -> Option<u32> {
        self.symbols.iter().position(|other| other == symbol).and_then(|id| u32::try_from(id).ok())
    }

    /// Tokens of one piece of text: its bytes, the best pair merged again and again.
    #[must_use]
    pub fn encode_piece(&self, piece: &str) -> Vec<u32> {
        match piece {
            BEGIN => return vec![self.begin],
            END => return vec![self.end],
            _ => {}
        }
        let last = piece.len().saturating_sub(1);
        let byte_id = |(i, byte): (usize, u8)| self.bytes[usize::from(i == last)][usize::from(byte)];
        let mut tokens: Vec<u32> = piece.bytes().enumerate().map(byte_id).collect();
        while let Some((pair, merged)) = self.best_pair(&tokens) {
            tokens = merge_all(&tokens, pair, merged);
        }
        tokens
    }

    fn best_pair(&self, tokens: &[u32]) -> Option<([u32; 2], u32)> {
        let ranked = tokens.windows(2).filter_map(|w| {
            let pair = [w[0], w[1]];
            self.by_pair.get(&pair).map(|(rank, merged)| (*rank, pair, *merged))
        });
        ranked.min_by_key(|(rank, ..)| *rank).map(|(_, pair, merged)| (pair, merged))
    }

    /// Text of tokens, a space behind each piece. Ids outside the vocabulary, begin and end are left out; bytes that
    /// form no character become U+FFFD.
    #[must_use]
    pub fn decode(&self, ids: &[u32]) -> String {
        let byte_of: HashMap<char, u8> = byte_symbols().into_iter().zip(0..=u8::MAX).collect();
        let mut bytes = Vec::new();
        for symbol in ids.iter().filter(|id| !self.marks().contains(id)).filter_map(|id| self.symbols.get(*id as usize))
        {
            let (text, space) = match symbol.strip_suffix(WORD_END) {
                Some(text) => (text, &b" "[..]),
                None => (symbol.as_str(), &[][..]),
            };
            bytes.extend(text.chars().filter_map(|symbol| byte_of.get(&symbol)));
            bytes.extend(space);
        }
        String::from_utf8_lossy(&bytes).trim_end().to_owned()
    }

    /// Texts of `vocab.json` and `merges.txt`.
    pub(super) fn to_files(&self) -> [(&'static str, String); 2] {
        let vocabulary: serde_json::Map<_, _> =
            self.symbols.iter().zip(0_u32..).map(|(symbol, id)| (symbol.clone(), id.into())).collect();
        let symbol = |id: u32| self.symbols.get(id as usize).map_or("", String::as_str);
        let lines = self.merges.iter().map(|[left, right]| format!("{} {}\n", symbol(*left), symbol(*right)));
        let merges = std::iter::once("#version: 0.2\n".to_owned()).chain(lines).collect();
        [("vocab.json", serde_json::Value::Object(vocabulary).to_string()), ("merges.txt", merges)]
    }
}

fn merge_all(tokens: &[u32], pair: [u32; 2], merged: u32) -> Vec<u32> {
    let mut out = Vec::with_capacity(tokens.len());
    let mut rest = tokens;
    while let Some((first, behind)) = rest.split_first() {
        let fits = *first == pair[0] && behind.first() == Some(&pair[1]);
        out.push(if fits { merged } else { *first });
        rest = &behind[usize::from(fits)..];
    }
    out
}

/// Bytes and the visible characters that stand for them, in the order of their ids: printable bytes stand for
/// themselves, then the others get the characters from U+0100 on.
fn bytes_in_order() -> Vec<(u8, char)> {
    let printable = |byte: &u8| matches!(byte, 33..=126 | 161..=172 | 174..=255);
    let themselves = (0..=u8::MAX).filter(printable).map(|byte| (byte, char::from(byte)));
    let others = (0..=u8::MAX).filter(|byte| !printable(byte)).zip('\u{100}'..);
    themselves.chain(others).collect()
}

/// The character that stands for each byte.
fn byte_symbols() -> Vec<char> {
    let mut pairs = bytes_in_order();
    pairs.sort_unstable();
    pairs.into_iter().map(|(_, symbol)| symbol).collect()
}

/// Lines with their numbers; the last line break ends no line.
fn numbered(text: &str) -> impl Iterator<Item = (usize, &str)> {
    (1..).zip(text.lines())
}

/// A text file, unpacked if it is packed with gzip.
fn read_text(path: &Path) -> Result<String, TextError> {
    let io = |source| TextError::Io { source, path: path.to_path_buf() };
    let mut text = String::new();
    let file = File::open(path).map_err(io)?;
    let packed = path.extension().is_some_and(|extension| extension == "gz");
    let mut reader: Box<dyn Read> = if packed { Box::new(GzDecoder::new(file)) } else { Box::new(file) };
    let read = reader.by_ref().take(MAX_TABLE_BYTES + 1).read_to_string(&mut text).map_err(io)?;
    if read as u64 > MAX_TABLE_BYTES {
        let reason = format!("more than {MAX_TABLE_BYTES} bytes");
        return Err(TextError::Format { reason, path: path.to_path_buf() });
    }
    Ok(text)
}
