"""What a model may lack: extensions (a file each), what they promise, their scores, and the search over them."""
