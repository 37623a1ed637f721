//! Which message the bytes of a gRPC body belong to.

use crate::ledger::Tally;
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use tonic::{Status, body::Body};

/// Finds the messages in a gRPC body: one byte of flags, four of length, then the message.
#[derive(Default)]
struct Messages {
    header: [u8; 5],
    header_bytes: usize,
    remaining: usize,
}

impl Messages {
    /// How many messages begin in this chunk (by the last byte of their header).
    fn feed(&mut self, mut chunk: &[u8]) -> u64 {
        let mut begun = 0;
        while !chunk.is_empty() {
            if self.remaining > 0 {
                let skipped = self.remaining.min(chunk.len());
                self.remaining -= skipped;
                chunk = &chunk[skipped..];
                continue;
            }
            self.header[self.header_bytes] = chunk[0];
            self.header_bytes += 1;
            chunk = &chunk[1..];
            if self.header_bytes == 5 {
                let [_, length @ ..] = self.header;
                self.remaining = u32::from_be_bytes(length) as usize;
                self.header_bytes = 0;
                begun += 1;
            }
        }
        begun
    }
}

/// A body that books what passes under a message type.
pub(crate) struct Metered {
    inner: Body,
    tally: Tally,
    message_type: String,
    messages: Messages,
}

impl Metered {
    /// `suffix` is `Request` or `Response`: the contract names every message `<Method><suffix>`.
    pub fn body(inner: Body, tally: Tally, path: &str, suffix: &str) -> Body {
        let method = path.rsplit('/').next().unwrap_or(path);
        let message_type = format!("{method}{suffix}");
        Body::new(Metered { inner, tally, message_type, messages: Messages::default() })
    }
}

impl http_body::Body for Metered {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let frame = ready!(Pin::new(&mut self.inner).poll_frame(cx));
        if let Some(Ok(frame)) = &frame
            && let Some(data) = frame.data_ref()
        {
            let begun = self.messages.feed(data);
            self.tally.add_message(&self.message_type, data.len() as u64, begun);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_counted_however_the_body_is_cut() {
        let mut body = Vec::new();
        for length in [0u32, 3, 700, 1] {
            body.push(0);
            body.extend(length.to_be_bytes());
            body.extend(vec![9; length as usize]);
        }
        for size in [1, 2, 4, 5, 6, 100, body.len()] {
            let mut messages = Messages::default();
            assert_eq!(body.chunks(size).map(|chunk| messages.feed(chunk)).sum::<u64>(), 4, "cut by {size}");
        }
    }
}
