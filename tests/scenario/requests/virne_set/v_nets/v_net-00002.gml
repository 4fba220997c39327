graph [
  node_attrs_setting "_networkx_list_start"
  node_attrs_setting [ name "cpu" type "resource" owner "node" low "0" high "100" ]
  topology___type "path"
  id 2
  arrival_time 4.0
  lifetime 3.25
  node [ id 0 label "0" cpu 1 ]
  node [ id 1 label "1" cpu 80 ]
  edge [ source 0 target 1 bw 0 ]
]
