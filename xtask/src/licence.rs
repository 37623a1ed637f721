//! SPDX licence expressions.

/// True if a user may take the package under licences that `allowed` accepts. `/` is the old way to write
/// `OR`; `A WITH B` is one licence by that name, and also accepted where plain `A` is, as an exception
/// only gives further permissions.
pub fn is_allowed(expression: &str, allowed: &dyn Fn(&str) -> bool) -> Result<bool, String> {
    let spaced = expression.replace('(', " ( ").replace(')', " ) ").replace('/', " OR ");
    let mut words = spaced.split_whitespace().peekable();
    let value = alternatives(&mut words, allowed)?;
    match words.next() {
        None => Ok(value),
        Some(word) => Err(format!("{expression:?}: unexpected {word:?}")),
    }
}

type Words<'a> = std::iter::Peekable<std::str::SplitWhitespace<'a>>;

/// `A OR B`, the loosest binding.
fn alternatives(words: &mut Words, allowed: &dyn Fn(&str) -> bool) -> Result<bool, String> {
    let mut value = conjunction(words, allowed)?;
    while words.next_if_eq(&"OR").is_some() {
        value |= conjunction(words, allowed)?;
    }
    Ok(value)
}

/// `A AND B`.
fn conjunction(words: &mut Words, allowed: &dyn Fn(&str) -> bool) -> Result<bool, String> {
    let mut value = licence(words, allowed)?;
    while words.next_if_eq(&"AND").is_some() {
        value &= licence(words, allowed)?;
    }
    Ok(value)
}

fn licence(words: &mut Words, allowed: &dyn Fn(&str) -> bool) -> Result<bool, String> {
    match words.next() {
        Some("(") => {
            let value = alternatives(words, allowed)?;
            words.next_if_eq(&")").map(|_| value).ok_or_else(|| "a bracket is not closed".to_string())
        }
        Some(word) if !matches!(word, ")" | "AND" | "OR" | "WITH") => {
            if words.next_if_eq(&"WITH").is_none() {
                return Ok(allowed(word));
            }
            let exception = words.next().ok_or_else(|| format!("{word} WITH nothing"))?;
            Ok(allowed(word) || allowed(&format!("{word} WITH {exception}")))
        }
        other => Err(format!("a licence was expected, not {other:?}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn free(expression: &str) -> bool {
        is_allowed(expression, &|licence| matches!(licence, "MIT" | "Apache-2.0")).unwrap()
    }

    #[test]
    fn one_allowed_alternative_is_enough_but_all_joined_ones_are_needed() {
        assert!(free("MIT OR GPL-3.0"));
        assert!(free("Unlicense/MIT"));
        assert!(!free("MIT AND GPL-3.0"));
        assert!(free("(GPL-3.0 OR MIT) AND Apache-2.0"));
        assert!(!free("GPL-3.0 OR MIT AND GPL-2.0"), "AND binds more tightly");
        assert!(free("Apache-2.0 WITH LLVM-exception"));
        assert!(!free("GPL-2.0 WITH Classpath-exception-2.0"));
    }

    #[test]
    fn what_is_no_expression_is_an_error() {
        for bad in ["", "MIT OR", "(MIT", "MIT Apache-2.0", "WITH x", "MIT WITH"] {
            assert!(is_allowed(bad, &|_| true).is_err(), "{bad:?}");
        }
    }
}
