//! A strict reader of the pages' markup.
#![allow(clippy::unwrap_used, missing_docs)]

/// Every start tag and its end tag, in order; void elements and self-closed ones stand alone. Panics where they do not nest.
pub(crate) fn check_nesting(html: &str) -> usize {
    const VOID: [&str; 4] = ["meta", "img", "br", "hr"];
    let mut open: Vec<&str> = Vec::new();
    let mut count = 0;
    let mut rest = html.strip_prefix("<!DOCTYPE html>").expect("doctype");
    while let Some(at) = rest.find('<') {
        let end = at + rest[at..].find('>').expect("unclosed tag");
        let tag = &rest[at + 1..end];
        assert_eq!(tag.matches('"').count() % 2, 0, "quotes in <{tag}>");
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name), "at </{name}>");
        } else {
            let name = tag.split([' ', '\n']).next().unwrap();
            assert!(name.chars().all(|c| c.is_ascii_alphanumeric()), "<{tag}>");
            count += 1;
            if !tag.ends_with('/') && !VOID.contains(&name) {
                open.push(name);
            }
        }
        rest = &rest[end + 1..];
    }
    assert!(open.is_empty(), "{open:?}");
    count
}
