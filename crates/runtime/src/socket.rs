//! A TCP stream that counts what it writes, and can be closed from outside.

use crate::ledger::Tally;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::OwnedSemaphorePermit;
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::transport::server::Connected;

/// What a request knows of the connection that it came on.
#[derive(Clone, Debug)]
pub(crate) struct Accepted {
    pub remote_addr: SocketAddr,
    pub tally: Tally,
}

pub(crate) struct CountedStream {
    stream: TcpStream,
    tally: Tally,
    /// Of the server's place for this connection, and the order to close it.
    accepted: Option<(OwnedSemaphorePermit, Pin<Box<WaitForCancellationFutureOwned>>, SocketAddr)>,
}

impl CountedStream {
    pub fn dialed(stream: TcpStream, tally: Tally) -> Self {
        CountedStream { stream, tally, accepted: None }
    }

    pub fn accepted(
        stream: TcpStream,
        tally: Tally,
        place: OwnedSemaphorePermit,
        close: WaitForCancellationFutureOwned,
        remote_addr: SocketAddr,
    ) -> Self {
        CountedStream { stream, tally, accepted: Some((place, Box::pin(close), remote_addr)) }
    }

    fn told_to_close(&mut self, cx: &mut Context<'_>) -> bool {
        self.accepted.as_mut().is_some_and(|(_, close, _)| close.as_mut().poll(cx).is_ready())
    }

    fn counted(&self, written: usize) -> Poll<io::Result<usize>> {
        self.tally.add_socket(written as u64);
        Poll::Ready(Ok(written))
    }
}

fn closed() -> io::Error {
    io::Error::new(io::ErrorKind::ConnectionAborted, "the server is shutting down")
}

impl AsyncRead for CountedStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.told_to_close(cx) {
            return Poll::Ready(Err(closed()));
        }
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl AsyncWrite for CountedStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = ready!(Pin::new(&mut self.stream).poll_write(cx, bytes))?;
        self.counted(written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = ready!(Pin::new(&mut self.stream).poll_write_vectored(cx, slices))?;
        self.counted(written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

impl Connected for CountedStream {
    type ConnectInfo = Accepted;

    fn connect_info(&self) -> Accepted {
        let unknown = SocketAddr::from(([0, 0, 0, 0], 0));
        let remote_addr = self.accepted.as_ref().map_or(unknown, |(_, _, addr)| *addr);
        Accepted { remote_addr, tally: self.tally.clone() }
    }
}
