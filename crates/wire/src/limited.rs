//! One limit for the messages of any generated server or client. tonic's own default, 4 MiB for what
//! comes in, is too small for raw frames.

use crate::v1::{
    agent_client::AgentClient, agent_server::AgentServer, dpgo_client::DpgoClient, dpgo_server::DpgoServer,
    peer_client::PeerClient, peer_server::PeerServer, place_recognition_client::PlaceRecognitionClient,
    place_recognition_server::PlaceRecognitionServer, viewer_client::ViewerClient,
    viewer_server::ViewerServer,
};
use tonic::body::Body;
use tonic::client::GrpcService;

/// Sets the largest message, both ways: `DpgoServer::new(service).limited(max_message_bytes)`.
pub trait Limited {
    /// With that limit, in bytes.
    fn limited(self, max_message_bytes: usize) -> Self;
}

macro_rules! limited {
    ($($server:ident, $client:ident;)*) => {$(
        impl<S> Limited for $server<S> {
            fn limited(self, max_message_bytes: usize) -> Self {
                self.max_decoding_message_size(max_message_bytes).max_encoding_message_size(max_message_bytes)
            }
        }

        impl<T> Limited for $client<T>
        where
            T: GrpcService<Body>,
            T::Error: Into<tonic::codegen::StdError>,
            T::ResponseBody: tonic::codegen::Body<Data = bytes::Bytes> + Send + 'static,
            <T::ResponseBody as tonic::codegen::Body>::Error: Into<tonic::codegen::StdError> + Send,
        {
            fn limited(self, max_message_bytes: usize) -> Self {
                self.max_decoding_message_size(max_message_bytes).max_encoding_message_size(max_message_bytes)
            }
        }
    )*};
}

limited! {
    AgentServer, AgentClient;
    PeerServer, PeerClient;
    PlaceRecognitionServer, PlaceRecognitionClient;
    DpgoServer, DpgoClient;
    ViewerServer, ViewerClient;
}
