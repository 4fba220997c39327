graph [
  name "triangle"
  node [ id 0 label "0" name "Rome" lat 41.9 lon 12.5 ]
  node [ id 1 label "1" name "Bern" lat 46.95 lon 7.45 ]
  node [ id 2 label "2" name "Graz" lat 47.07 lon 15.44 ]
  edge [ source 0 target 1 dist 690.0 ecmp_fwd [ uni 15.5 ] ]
  edge [ source 0 target 2 dist 620.0 ecmp_fwd [ uni 1.5 ] ]
  edge [ source 1 target 2 dist 600.0 ecmp_fwd [ uni 3.5 ] ]
]
