//! Just enough reading of Rust to see which paths a source names outside its tests.

/// The code of a source: comments and the insides of strings and characters blanked, as many lines as
/// before.
pub fn code(source: &str) -> String {
    let bytes = source.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while at < bytes.len() {
        let end = skip(bytes, at);
        if end > at {
            out.extend(bytes[at..end].iter().map(|b| if *b == b'\n' { b'\n' } else { b' ' }));
            at = end;
        } else {
            out.push(bytes[at]);
            at += 1;
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// Where the comment, string or character that begins at `at` ends; `at` if none does.
fn skip(bytes: &[u8], at: usize) -> usize {
    let rest = &bytes[at..];
    let previous_is_word = at > 0 && is_word(bytes[at - 1]);
    if rest.starts_with(b"//") {
        return at + rest.iter().position(|b| *b == b'\n').unwrap_or(rest.len());
    }
    if rest.starts_with(b"/*") {
        let (mut depth, mut i) = (0usize, 0);
        while i < rest.len() {
            if rest[i..].starts_with(b"/*") {
                depth += 1;
                i += 2;
            } else if rest[i..].starts_with(b"*/") {
                depth -= 1;
                i += 2;
                if depth == 0 {
                    break;
                }
            } else {
                i += 1;
            }
        }
        return at + i.min(rest.len());
    }
    if !previous_is_word || matches!(bytes[at - 1], b'b' | b'c') {
        let hashes = rest.iter().skip(1).take_while(|b| **b == b'#').count();
        if rest[0] == b'r' && rest.get(1 + hashes) == Some(&b'"') {
            let close = [&b"\""[..], &b"#".repeat(hashes)].concat();
            let body = &rest[2 + hashes..];
            let end = body.windows(close.len()).position(|w| w == close);
            return at + end.map_or(rest.len(), |e| 2 + hashes + e + close.len());
        }
    }
    if rest[0] == b'"' {
        return at + quoted_end(rest, b'"');
    }
    // A character, not a lifetime: '\n', 'x' or one of several bytes.
    if rest[0] == b'\'' && (rest.get(1) == Some(&b'\\') || is_char_literal(rest)) {
        return at + quoted_end(rest, b'\'');
    }
    at
}

fn is_char_literal(rest: &[u8]) -> bool {
    let width = match rest.get(1) {
        Some(b) if *b < 0x80 => 1,
        Some(b) if *b >= 0xf0 => 4,
        Some(b) if *b >= 0xe0 => 3,
        Some(_) => 2,
        None => return false,
    };
    rest.get(1 + width) == Some(&b'\'')
}

fn quoted_end(rest: &[u8], quote: u8) -> usize {
    let mut i = 1;
    while i < rest.len() && rest[i] != quote {
        i += if rest[i] == b'\\' { 2 } else { 1 };
    }
    (i + 1).min(rest.len())
}

fn is_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_' || byte >= 0x80
}

/// Code (see [`code`]) without the items under `#[cfg(test)]`, and the names of the modules among them
/// that lie in files of their own.
pub fn without_tests(code: &str) -> (String, Vec<String>) {
    const MARK: &str = "#[cfg(test)]";
    let mut kept = String::new();
    let mut files = Vec::new();
    let mut rest = code;
    while let Some(begin) = rest.find(MARK) {
        let after = &rest[begin + MARK.len()..];
        let end = item_end(after);
        let item = &after[..end];
        if let (Some(name), true) = (item.trim().strip_suffix(';'), item.contains("mod ")) {
            files.extend(name.rsplit("mod ").next().map(|name| name.trim().to_string()));
        }
        kept.push_str(&rest[..begin]);
        kept.extend(item.chars().filter(|c| *c == '\n'));
        rest = &after[end..];
    }
    kept.push_str(rest);
    (kept, files)
}

/// Where an item ends: at a `;` outside brackets, or after its closing brace.
fn item_end(code: &str) -> usize {
    let mut depth = 0i32;
    for (i, c) in code.char_indices() {
        match c {
            '{' | '(' | '[' => depth += 1,
            '}' | ')' | ']' => {
                depth -= 1;
                if c == '}' && depth == 0 {
                    return i + 1;
                }
            }
            ';' if depth == 0 => return i + 1,
            _ => {}
        }
    }
    code.len()
}

/// Every path that code (see [`code`]) names, with its line: `use` trees are written out one by one
/// (`use a::{b, c as d}` gives `a::b`, `a::c as d`); a word alone is a path of one part.
pub fn paths(code: &str) -> Vec<(usize, String)> {
    let tokens = tokens(code);
    let mut out = Vec::new();
    let mut i = 0;
    while i < tokens.len() {
        let (line, token) = tokens[i];
        if token == "use" {
            let (mut expanded, end) = use_tree(&tokens, i + 1, "");
            expanded.iter_mut().for_each(|path| out.push((line, std::mem::take(path))));
            i = end;
        } else if token.as_bytes().first().is_some_and(|b| is_word(*b)) {
            let mut path = token.to_string();
            while i + 2 < tokens.len() && tokens[i + 1].1 == "::" && is_word(tokens[i + 2].1.as_bytes()[0]) {
                path = format!("{path}::{}", tokens[i + 2].1);
                i += 2;
            }
            out.push((line, path));
            i += 1;
        } else {
            i += 1;
        }
    }
    out
}

/// The paths of a use tree that begins at token `at`, and the token after it.
fn use_tree(tokens: &[(usize, &str)], mut at: usize, prefix: &str) -> (Vec<String>, usize) {
    let mut path = prefix.to_string();
    while at < tokens.len() {
        match tokens[at].1 {
            "::" => at += 1,
            "{" => {
                let mut out = Vec::new();
                at += 1;
                while at < tokens.len() && tokens[at].1 != "}" {
                    if tokens[at].1 == "," {
                        at += 1;
                        continue;
                    }
                    let (paths, end) = use_tree(tokens, at, &path);
                    out.extend(paths);
                    at = end.max(at + 1);
                }
                return (out, at + 1);
            }
            "," | "}" | ";" => break,
            "as" => {
                let name = tokens.get(at + 1).map_or("_", |t| t.1);
                return (vec![format!("{path} as {name}")], at + 2);
            }
            "self" if !path.is_empty() => at += 1,
            word => {
                path = if path.is_empty() { word.to_string() } else { format!("{path}::{word}") };
                at += 1;
            }
        }
    }
    (vec![path], at)
}

/// Words, `::` and single signs, each with its line (from 1).
fn tokens(code: &str) -> Vec<(usize, &str)> {
    let bytes = code.as_bytes();
    let (mut at, mut line) = (0, 1);
    let mut out = Vec::new();
    while at < bytes.len() {
        let begin = at;
        if is_word(bytes[at]) {
            while at < bytes.len() && is_word(bytes[at]) {
                at += 1;
            }
        } else if bytes[at..].starts_with(b"::") {
            at += 2;
        } else {
            at += 1;
        }
        if bytes[begin] == b'\n' {
            line += 1;
        }
        if !bytes[begin].is_ascii_whitespace() {
            out.push((line, &code[begin..at]));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(source: &str) -> Vec<String> {
        paths(&without_tests(&code(source)).0).into_iter().map(|(_, path)| path).collect()
    }

    #[test]
    fn comments_and_strings_are_not_code() {
        let source = "// std::fs\n/* a /* std::net */ b */ let x = \"std::fs \\\" tokio\"; let c = '\"'; let r = r#\"tokio \"# ; y";
        assert_eq!(named(source), ["let", "x", "let", "c", "let", "r", "y"]);
    }

    #[test]
    fn a_lifetime_is_not_a_character() {
        assert_eq!(
            named("fn f<'a>(x: &'a u8) { tokio('ä', '\\'') }"),
            ["fn", "f", "a", "x", "a", "u8", "tokio"]
        );
    }

    #[test]
    fn use_trees_are_written_out() {
        let source = "use std::{fs, time::{self, Duration, Instant as Now}, net::*};";
        let expected =
            ["std::fs", "std::time", "std::time::Duration", "std::time::Instant as Now", "std::net::*"];
        assert_eq!(named(source), expected);
    }

    #[test]
    fn paths_inside_code_are_found_with_their_line() {
        let found = paths("fn f() {\n  std::fs::read(p)\n}");
        assert!(found.contains(&(2, "std::fs::read".into())), "{found:?}");
    }

    #[test]
    fn what_is_only_tested_is_left_out() {
        let source = "fn a() {}\n#[cfg(test)]\nmod tests { fn b() { std::fs::read(); } }\nfn c() {}";
        assert_eq!(named(source), ["fn", "a", "fn", "c"]);
        let (kept, files) = without_tests("#[cfg(test)]\nmod oracle;\nfn c() {}");
        assert_eq!((kept.trim(), files.as_slice()), ("fn c() {}", &["oracle".to_string()][..]));
    }
}
