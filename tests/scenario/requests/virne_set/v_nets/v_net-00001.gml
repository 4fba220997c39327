graph [
  node_attrs_setting "_networkx_list_start"
  node_attrs_setting [ name "cpu" type "resource" owner "node" low "0" high "100" ]
  topology___type "path"
  id 1
  arrival_time 2.0
  lifetime 4.5
  node [ id 0 label "0" cpu 70 ]
  node [ id 1 label "1" cpu 60 ]
  edge [ source 0 target 1 bw 20 ]
]
