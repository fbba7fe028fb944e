"""Light transport through glass: layered panes, rough surfaces, emitters, defocus and sampling."""
