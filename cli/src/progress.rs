//! Progress bars: on a terminal only.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;

/// Frames of one agent, with frames per second and the time that is left.
pub fn frames(name: &str, length: u64) -> ProgressBar {
    bar(name, length, "{prefix:>12} [{bar:30}] {pos}/{len} {per_sec:>10} {eta:>6} left {msg}")
}

fn bar(name: &str, length: u64, template: &str) -> ProgressBar {
    let target = if std::io::stderr().is_terminal() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    };
    let style = ProgressStyle::with_template(template).expect("the template is fixed").progress_chars("=> ");
    ProgressBar::with_draw_target(Some(length), target).with_style(style).with_prefix(name.to_owned())
}

/// Something that takes a while; its message says what.
pub fn spinner(name: &str) -> ProgressBar {
    bar(name, 0, "{prefix:>12} {spinner} {msg}")
}

/// Steps of some work.
pub fn steps(name: &str, length: u64) -> ProgressBar {
    bar(name, length, "{prefix:>12} [{bar:30}] {pos}/{len} {eta:>6} left {msg}")
}
