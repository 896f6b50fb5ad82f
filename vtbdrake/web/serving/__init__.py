"""What serves all pages: who may open one, the web server, https, the relay of Meshcat, pages in notebooks."""
