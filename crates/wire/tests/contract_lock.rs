//! The contract as text, so that every change of it is seen in review.
//!
//! `COMA_BLESS=1 cargo test --release -p coma-wire --test contract_lock` accepts a change.

use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, EnumDescriptorProto, FieldDescriptorProto, FileDescriptorSet};
use std::collections::BTreeMap;
use std::fmt::Write;

fn descriptors() -> FileDescriptorSet {
    FileDescriptorSet::decode(coma_wire::FILE_DESCRIPTOR_SET).unwrap()
}

fn short(name: &str) -> &str {
    name.trim_start_matches(".coma.v1.")
}

fn field_type(field: &FieldDescriptorProto, nested: &[DescriptorProto]) -> String {
    if let Some(entry) = nested.iter().find(|n| short(field.type_name()).ends_with(&format!(".{}", n.name())))
    {
        let [key, value] = &entry.field[..] else { panic!("a map entry has a key and a value") };
        return format!("map<{}, {}>", field_type(key, &[]), field_type(value, &[]));
    }
    let base = match field.r#type() {
        Type::Message | Type::Enum => short(field.type_name()).to_owned(),
        other => other.as_str_name().trim_start_matches("TYPE_").to_lowercase(),
    };
    match field.label() {
        Label::Repeated => format!("repeated {base}"),
        _ if field.proto3_optional() => format!("optional {base}"),
        _ => base,
    }
}

fn message(out: &mut String, name: &str, m: &DescriptorProto) {
    writeln!(out, "message {name}").unwrap();
    let mut fields: Vec<_> = m.field.iter().collect();
    fields.sort_by_key(|f| f.number());
    for field in fields {
        let oneof = match field.oneof_index {
            Some(i) if !field.proto3_optional() => format!("  (oneof {})", m.oneof_decl[i as usize].name()),
            _ => String::new(),
        };
        let kind = field_type(field, &m.nested_type);
        writeln!(out, "  {:>3} {}: {kind}{oneof}", field.number(), field.name()).unwrap();
    }
    for range in &m.reserved_range {
        writeln!(out, "  reserved {} to {}", range.start(), range.end() - 1).unwrap();
    }
    for name in &m.reserved_name {
        writeln!(out, "  reserved {name:?}").unwrap();
    }
}

fn enumeration(out: &mut String, e: &EnumDescriptorProto) {
    writeln!(out, "enum {}", e.name()).unwrap();
    for value in &e.value {
        writeln!(out, "  {:>3} {}", value.number(), value.name()).unwrap();
    }
}

/// Services, then enumerations, then messages, each by name.
fn render(set: &FileDescriptorSet) -> String {
    let mut parts: BTreeMap<(u8, String), String> = BTreeMap::new();
    for file in &set.file {
        assert_eq!(file.package(), "coma.v1");
        for service in &file.service {
            let mut out = format!("service {}\n", service.name());
            for method in &service.method {
                let stream = |on: bool| if on { "stream " } else { "" };
                writeln!(
                    out,
                    "  {}({}{}) -> {}{}",
                    method.name(),
                    stream(method.client_streaming()),
                    short(method.input_type()),
                    stream(method.server_streaming()),
                    short(method.output_type())
                )
                .unwrap();
            }
            parts.insert((0, service.name().to_owned()), out);
        }
        for e in &file.enum_type {
            let mut out = String::new();
            enumeration(&mut out, e);
            parts.insert((1, e.name().to_owned()), out);
        }
        for m in &file.message_type {
            let mut out = String::new();
            message(&mut out, m.name(), m);
            parts.insert((2, m.name().to_owned()), out);
        }
    }
    let head = "The contract coma.v1, written by `COMA_BLESS=1 cargo test --release -p coma-wire --test contract_lock`.\n";
    head.to_owned() + "\n" + &parts.into_values().collect::<Vec<_>>().join("\n")
}

#[test]
fn the_contract_is_the_one_that_was_reviewed() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../proto/contract.lock.txt");
    let text = render(&descriptors());
    if std::env::var_os("COMA_BLESS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let locked = std::fs::read_to_string(&path).unwrap_or_default();
    if let Some((n, (was, is))) = locked.lines().zip(text.lines()).enumerate().find(|(_, (a, b))| a != b) {
        panic!("line {}: was {was:?}, is {is:?}; accept with COMA_BLESS=1", n + 1);
    }
    assert_eq!(locked.len(), text.len(), "the contract grew or shrank at its end; accept with COMA_BLESS=1");
}

#[test]
fn a_changed_number_a_changed_type_and_a_new_method_all_show() {
    let before = render(&descriptors());
    let changed = |change: &dyn Fn(&mut FileDescriptorSet)| {
        let mut set = descriptors();
        change(&mut set);
        render(&set) != before
    };
    fn of<'a>(set: &'a mut FileDescriptorSet, name: &str) -> &'a mut DescriptorProto {
        set.file.iter_mut().flat_map(|f| &mut f.message_type).find(|m| m.name() == name).unwrap()
    }
    assert!(!changed(&|_| ()));
    assert!(changed(&|s| of(s, "Pose").field[0].number = Some(99)));
    assert!(changed(&|s| of(s, "Frame").field[0].set_type(Type::Int32)));
    assert!(changed(&|s| of(s, "Frame").reserved_range.clear()));
    assert!(changed(&|s| {
        let service = s.file.iter_mut().flat_map(|f| &mut f.service).next().unwrap();
        let extra = service.method[0].clone();
        service.method.push(prost_types::MethodDescriptorProto { name: Some("Extra".into()), ..extra });
    }));
}
