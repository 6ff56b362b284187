//! `--http` of `fly` and `serve`.

use std::path::PathBuf;

use config::http::HttpSettings;
use pages::watch::{Server, Token, Watch};

use super::CliError;

/// The live page.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Live page")]
pub struct HttpArgs {
    /// Serve a live page at this address, e.g. 127.0.0.1:8080; port 0 takes a free one. Addresses that others reach need a token.
    #[arg(long, value_name = "ADDR")]
    http: Option<String>,
    /// File of the token that a browser shows once as ?token=TOKEN [default: the mission's `[http] token_file`]. Nothing is
    /// encrypted: use a VPN or an SSH tunnel where others listen.
    #[arg(long, value_name = "FILE", requires = "http")]
    http_token_file: Option<PathBuf>,
}

impl HttpArgs {
    /// Serves `watch`, when asked to, until the server is dropped.
    ///
    /// # Errors
    /// An address that cannot be listened on or that others reach without a token.
    pub fn serve(&self, settings: &HttpSettings, watch: &Watch) -> Result<Option<Server>, CliError> {
        let Some(at) = &self.http else { return Ok(None) };
        let file = self.http_token_file.as_deref().or(settings.token_file.as_deref());
        let server = Server::start(at, file.map(Token::read).transpose()?, watch.clone())?;
        tracing::info!("live page: http://{}/", server.address());
        Ok(Some(server))
    }
}
