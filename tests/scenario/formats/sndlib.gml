Creator  "sndlib.ext.generators.gml.ProblemGmlGenerator"
Version  "1.0"

graph [
  label     "triangle"
  directed  1
  node [ id 0 label "Rome" LabelGraphics [ fontSize 13 ] graphics [ x 184.7 y 894.3 fill "#cccccc" ] ]
  node [ id 1 label "Bern" LabelGraphics [ fontSize 13 ] graphics [ x 179.3 y 850.2 fill "#cccccc" ] ]
  node [ id 2 label "Graz" LabelGraphics [ fontSize 13 ] graphics [ x 168.8 y 395.5 fill "#cccccc" ] ]
  edge [ id 0 source 1 target 0 graphics [ width 1 style "standard" ] ]
  edge [ id 1 source 2 target 1 graphics [ width 1 style "standard" ] ]
]
