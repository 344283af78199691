//! Writes checkpoints as PyTorch Lightning does: a zip archive of a pickle and one entry per storage.

use std::io::{Cursor, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Name, shape, values.
pub type Named = (String, Vec<usize>, Vec<f32>);

/// Where averaged weights go.
pub enum Averaged<'a> {
    /// Nowhere.
    Absent,
    /// `optimizer_states[0]["ema"]`, a list.
    List(&'a [Named]),
    /// `callbacks["Ema"]["shadow"]`, by name behind `module.`.
    Callback(&'a [Named]),
    /// `state_dict`, with the current weights in `current_model_state`.
    StateDict(&'a [Named]),
}

/// A whole checkpoint.
pub fn checkpoint(state: &[Named], averaged: &Averaged) -> Vec<u8> {
    archive(&pickled(state, averaged), CompressionMethod::Stored)
}

/// As [`checkpoint`], with all entries compressed, which `torch.save` never does.
pub fn compressed(state: &[Named]) -> Vec<u8> {
    archive(&pickled(state, &Averaged::Absent), CompressionMethod::Deflated)
}

fn pickled<'a>(state: &'a [Named], averaged: &Averaged<'a>) -> Pickle<'a> {
    let mut p = Pickle::default();
    p.bytes.extend(b"\x80\x02}(");
    p.text("epoch");
    p.number(3);
    p.text("state_dict");
    p.dictionary(if let Averaged::StateDict(average) = averaged { average } else { state }, "");
    if let Averaged::StateDict(_) = averaged {
        p.text("current_model_state");
        p.dictionary(state, "");
    }
    p.text("optimizer_states");
    p.bytes.extend(b"](}(");
    p.text("state");
    p.bytes.extend(b"}");
    if let Averaged::List(list) = averaged {
        p.text("ema");
        p.bytes.extend(b"](");
        list.iter().for_each(|named| p.tensor(named));
        p.bytes.extend(b"e");
    }
    p.bytes.extend(b"ue");
    p.text("callbacks");
    p.bytes.extend(b"}(");
    if let Averaged::Callback(average) = averaged {
        p.text("Ema");
        p.bytes.extend(b"}(");
        p.text("shadow");
        p.dictionary(average, "module.");
        p.bytes.extend(b"u");
    }
    p.bytes.extend(b"uu.");
    p
}

/// Opcodes of protocol 2 and the storages they name.
#[derive(Default)]
struct Pickle<'a> {
    bytes: Vec<u8>,
    storages: Vec<&'a [f32]>,
}

impl<'a> Pickle<'a> {
    fn text(&mut self, text: &str) {
        self.bytes.push(b'X');
        self.bytes.extend((text.len() as u32).to_le_bytes());
        self.bytes.extend(text.as_bytes());
    }

    fn number(&mut self, number: usize) {
        self.bytes.push(b'J');
        self.bytes.extend((number as i32).to_le_bytes());
    }

    fn tuple(&mut self, numbers: &[usize]) {
        self.bytes.push(b'(');
        numbers.iter().for_each(|number| self.number(*number));
        self.bytes.push(b't');
    }

    fn dictionary(&mut self, tensors: &'a [Named], prefix: &str) {
        self.bytes.extend(b"ccollections\nOrderedDict\n)R(");
        for named in tensors {
            self.text(&format!("{prefix}{}", named.0));
            self.tensor(named);
        }
        self.bytes.push(b'u');
    }

    fn tensor(&mut self, (_, shape, values): &'a Named) {
        let key = self.storages.len().to_string();
        self.storages.push(values);
        self.bytes.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        self.text("storage");
        self.bytes.extend(b"ctorch\nFloatStorage\n");
        self.text(&key);
        self.text("cpu");
        self.number(values.len());
        self.bytes.extend(b"tQ");
        self.number(0);
        self.tuple(shape);
        let strides: Vec<usize> = (0..shape.len()).map(|axis| shape[axis + 1..].iter().product()).collect();
        self.tuple(&strides);
        self.bytes.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
}

fn archive(pickle: &Pickle, method: CompressionMethod) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    let mut put = |name: String, bytes: &[u8]| {
        zip.start_file(name, options).unwrap();
        zip.write_all(bytes).unwrap();
    };
    put("archive/data.pkl".to_owned(), &pickle.bytes);
    for (key, values) in pickle.storages.iter().enumerate() {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        put(format!("archive/data/{key}"), &bytes);
    }
    zip.finish().unwrap().into_inner()
}
