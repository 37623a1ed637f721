//! Tables, as Markdown that a terminal shows well and as HTML.

/// Rows of text under a header. The first columns are texts, the others figures, which stand to the right.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Table {
    header: Vec<String>,
    text_columns: usize,
    rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new(text_columns: usize, header: &[&str]) -> Self {
        let header = header.iter().map(|name| (*name).to_owned()).collect();
        Table { header, text_columns, rows: Vec::new() }
    }

    /// A row has a cell for every column; what is missing is empty.
    pub fn push(&mut self, row: impl IntoIterator<Item = String>) {
        let mut row: Vec<String> = row.into_iter().collect();
        row.resize(self.header.len(), String::new());
        self.rows.push(row);
    }

    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    pub fn markdown(&self) -> String {
        let escape = |cell: &String| cell.replace('|', "\\|").replace(['\n', '\r'], " ");
        let header: Vec<String> = self.header.iter().map(escape).collect();
        let rows: Vec<Vec<String>> = self.rows.iter().map(|row| row.iter().map(escape).collect()).collect();
        let width = |column: usize| {
            let cells = std::iter::once(&header).chain(&rows).map(|row| row[column].chars().count());
            cells.max().unwrap_or(0).max(3)
        };
        let widths: Vec<usize> = (0..header.len()).map(width).collect();
        let line = |row: &[String]| {
            let cells: Vec<String> = row
                .iter()
                .zip(&widths)
                .enumerate()
                .map(|(column, (cell, width))| match column < self.text_columns {
                    true => format!("{cell:<width$}"),
                    false => format!("{cell:>width$}"),
                })
                .collect();
            format!("| {} |\n", cells.join(" | "))
        };
        let rules: Vec<String> = widths
            .iter()
            .enumerate()
            .map(|(column, width)| match column < self.text_columns {
                true => "-".repeat(*width),
                false => "-".repeat(width - 1) + ":",
            })
            .collect();
        let body: String = rows.iter().map(|row| line(row)).collect();
        line(&header) + &line(&rules) + &body
    }

    pub fn html(&self) -> String {
        let cells = |row: &[String], tag: &str| {
            let cells = row.iter().enumerate().map(|(column, cell)| {
                let class = if column < self.text_columns { "" } else { " class=\"n\"" };
                format!("<{tag}{class}>{}</{tag}>", escape_html(cell))
            });
            format!("<tr>{}</tr>\n", cells.collect::<String>())
        };
        let body: String = self.rows.iter().map(|row| cells(row, "td")).collect();
        format!(
            "<div class=\"scroll\"><table>\n<thead>{}</thead>\n<tbody>\n{body}</tbody>\n</table></div>\n",
            cells(&self.header, "th").trim_end()
        )
    }
}

pub(super) fn escape_html(text: &str) -> String {
    text.chars().fold(String::with_capacity(text.len()), |mut out, c| {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
        out
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let mut table = Table::new(1, &["name", "bytes"]);
        table.push(["a|b".to_owned(), "12".to_owned()]);
        table.push(["<i>".to_owned()]);
        table
    }

    #[test]
    fn markdown_is_aligned_and_keeps_its_columns() {
        let expected = "\
| name | bytes |
| ---- | ----: |
| a\\|b |    12 |
| <i>  |       |
";
        assert_eq!(table().markdown(), expected);
    }

    #[test]
    fn html_shows_texts_as_they_are() {
        let html = table().html();
        assert!(html.contains("<td>&lt;i&gt;</td>") && html.contains("<td class=\"n\">12</td>"), "{html}");
    }
}
