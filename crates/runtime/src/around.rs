//! A tower layer made of one async function around the rest of the stack.

use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use tonic::body::Body;
use tower::util::BoxCloneSyncService;
use tower::{Layer, Service};

pub(crate) type Request = http::Request<Body>;
pub(crate) type Response = http::Response<Body>;
/// The rest of the stack.
pub(crate) type Next = BoxCloneSyncService<Request, Response, Infallible>;

/// `around(f)`: `f(request, next)` answers, calling `next` or not.
pub(crate) fn around<F>(f: F) -> AroundLayer<F> {
    AroundLayer(f)
}

#[derive(Clone)]
pub(crate) struct AroundLayer<F>(F);

#[derive(Clone)]
pub(crate) struct Around<F> {
    f: F,
    next: Next,
}

impl<F, S> Layer<S> for AroundLayer<F>
where
    F: Clone,
    S: Service<Request, Response = Response, Error = Infallible> + Clone + Send + Sync + 'static,
    S::Future: Send + 'static,
{
    type Service = Around<F>;

    fn layer(&self, inner: S) -> Around<F> {
        Around { f: self.0.clone(), next: BoxCloneSyncService::new(inner) }
    }
}

impl<F, Fut> Service<Request> for Around<F>
where
    F: Fn(Request, Next) -> Fut,
    Fut: Future<Output = Response> + Send + 'static,
{
    type Response = Response;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Response, Infallible>> + Send>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.next.poll_ready(cx)
    }

    fn call(&mut self, request: Request) -> Self::Future {
        // The one that was polled ready is the one that is called.
        let fresh = self.next.clone();
        let ready = std::mem::replace(&mut self.next, fresh);
        let answer = (self.f)(request, ready);
        Box::pin(async move { Ok(answer.await) })
    }
}

/// Calls the rest of the stack.
pub(crate) async fn pass(mut next: Next, request: Request) -> Response {
    match next.call(request).await {
        Ok(response) => response,
        Err(never) => match never {},
    }
}
