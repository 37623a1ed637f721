//! Tiny ONNX files, written field by field as `onnx.proto` numbers them, so that no test needs a downloaded model.

use std::path::{Path, PathBuf};

fn varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn number(field: u64, value: u64) -> Vec<u8> {
    let mut out = Vec::new();
    varint(field << 3, &mut out);
    varint(value, &mut out);
    out
}

fn bytes(field: u64, content: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    varint(field << 3 | 2, &mut out);
    varint(content.len() as u64, &mut out);
    out.extend_from_slice(content);
    out
}

/// A tensor of 32-bit floats by name; a side is a number or, as `None`, free.
pub struct Port(pub &'static str, pub &'static [Option<u64>]);

impl Port {
    fn encode(&self) -> Vec<u8> {
        let side = |side: &Option<u64>| match side {
            Some(side) => bytes(1, &number(1, *side)),
            None => bytes(1, &bytes(2, b"free")),
        };
        let shape: Vec<u8> = self.1.iter().flat_map(side).collect();
        let tensor = [number(1, 1), bytes(2, &shape)].concat();
        [bytes(1, self.0.as_bytes()), bytes(2, &bytes(1, &tensor))].concat()
    }
}

/// A node: what it computes, from which names, to which name.
pub struct Node(pub &'static str, pub &'static [&'static str], pub &'static str);

impl Node {
    fn encode(&self) -> Vec<u8> {
        let inputs: Vec<u8> = self.1.iter().flat_map(|name| bytes(1, name.as_bytes())).collect();
        [inputs, bytes(2, self.2.as_bytes()), bytes(4, self.0.as_bytes())].concat()
    }
}

/// Writes a model.
pub fn write_model(folder: &Path, inputs: &[Port], nodes: &[Node], output: Port) -> PathBuf {
    let mut graph: Vec<u8> = nodes.iter().flat_map(|node| bytes(1, &node.encode())).collect();
    graph.extend(bytes(2, b"test"));
    graph.extend(inputs.iter().flat_map(|port| bytes(11, &port.encode())));
    graph.extend(bytes(12, &output.encode()));
    let model = [number(1, 8), bytes(7, &graph), bytes(8, &number(2, 13))].concat();
    let path = folder.join("model.onnx");
    std::fs::write(&path, model).unwrap();
    path
}
